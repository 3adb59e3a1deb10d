// The scan: reading it from the server, drawing it, and finding the point of its surface under a pixel.
"use strict";

const TANGENT = 0.25;  // tangent of half the vertical field of view

async function readMesh(about) {
  const answer = await fetch("mesh");
  if (!answer.ok) throw new Error("The scan could not be read from skindb. Is it still running?");
  const bytes = await answer.arrayBuffer(), v = about.vertices, f = about.faces;
  return {
    position: new Float32Array(bytes, 0, 3 * v),
    normal: new Float32Array(bytes, 12 * v, 3 * v),
    triangles: new Uint32Array(bytes, 24 * v, 3 * f),
    colour: about.colours ? new Uint8Array(bytes, 24 * v + 12 * f, 3 * v) : null,
  };
}

function bounds(position) {
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  for (let i = 0; i < position.length; i++) {
    low[i % 3] = Math.min(low[i % 3], position[i]);
    high[i % 3] = Math.max(high[i % 3], position[i]);
  }
  return { low, high };
}

// the first intersection of a ray with the triangles (Moeller and Trumbore 1997), or null
function pick({ position: p, triangles }, origin, ray) {
  const [ox, oy, oz] = origin, [dx, dy, dz] = ray;
  let best = Infinity;
  for (let i = 0; i < triangles.length; i += 3) {
    const a = 3 * triangles[i], b = 3 * triangles[i + 1], c = 3 * triangles[i + 2];
    const ax = p[a], ay = p[a + 1], az = p[a + 2];
    const ux = p[b] - ax, uy = p[b + 1] - ay, uz = p[b + 2] - az;
    const vx = p[c] - ax, vy = p[c + 1] - ay, vz = p[c + 2] - az;
    const hx = dy * vz - dz * vy, hy = dz * vx - dx * vz, hz = dx * vy - dy * vx;
    const det = ux * hx + uy * hy + uz * hz;
    if (det === 0) continue;
    const sx = ox - ax, sy = oy - ay, sz = oz - az;
    const s = (sx * hx + sy * hy + sz * hz) / det;
    if (!(s >= 0 && s <= 1)) continue;
    const qx = sy * uz - sz * uy, qy = sz * ux - sx * uz, qz = sx * uy - sy * ux;
    const t = (dx * qx + dy * qy + dz * qz) / det;
    if (!(t >= 0 && s + t <= 1)) continue;
    const far = (vx * qx + vy * qy + vz * qz) / det;
    if (far > 0 && far < best) best = far;
  }
  return best < Infinity ? [ox + best * dx, oy + best * dy, oz + best * dz] : null;
}

// position of the camera of a view, and its axes
function frame(view) {
  const back = direction(view.azimuth, view.elevation), eye = add(view.target, back, view.distance);
  const right = unit(cross([0, 1, 0], back));
  return { eye, back, right, up: cross(back, right) };
}

// the ray through a point of the canvas, in CSS px from its upper left corner
function rayThrough(canvas, view, x, y) {
  const { eye, back, right, up } = frame(view), { width, height } = canvas.getBoundingClientRect();
  const across = ((2 * x - width) / height) * TANGENT, above = (1 - (2 * y) / height) * TANGENT;
  return { origin: eye, ray: unit(add(add(back.map((c) => -c), right, across), up, above)) };
}

// position on the canvas [CSS px] of a point [mm]
function project(canvas, view, point) {
  const { eye, back, right, up } = frame(view), { width, height } = canvas.getBoundingClientRect();
  const to = sub(point, eye), depth = -dot(to, back) * TANGENT;
  return [(width + (dot(to, right) / depth) * height) / 2, (height * (1 - dot(to, up) / depth)) / 2];
}

class ScanPainter {
  constructor(canvas, mesh) {
    this.canvas = canvas;
    this.mesh = mesh;
    const gl = canvas.getContext("webgl2", { antialias: !isSoftware(), preserveDrawingBuffer: true });
    if (!gl) throw new Error("This browser has no WebGL2. Use another browser, or switch on hardware acceleration.");
    this.gl = gl;
    this.prepare();
  }

  prepare() {
    const gl = this.gl;
    this.programs = { scan: compile(gl, "scan"), mark: compile(gl, "mark") };
    this.surface = gl.createVertexArray();
    gl.bindVertexArray(this.surface);
    buffer(gl, 0, 3, this.mesh.position);
    buffer(gl, 1, 3, this.mesh.normal);
    if (this.mesh.colour) buffer(gl, 2, 3, Float32Array.from(this.mesh.colour, (value) => value / 255));
    this.triangles = indices(gl, this.mesh.triangles);
    this.marks = gl.createVertexArray();
    gl.bindVertexArray(this.marks);
    this.places = buffer(gl, 0, 3, new Float32Array(3));
    gl.bindVertexArray(null);
  }

  // `marks` are groups of points, each with a colour and a size in px
  draw(view, box, coloured, marks) {
    const gl = this.gl, canvas = this.canvas, ratio = window.devicePixelRatio || 1;
    const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.viewport(0, 0, width, height);
    gl.enable(gl.DEPTH_TEST);
    gl.clearColor(0.07, 0.07, 0.08, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const { eye, up } = frame(view), near = view.distance / 50, far = view.distance + 4 * view.size;
    const matrix = product(perspective(TANGENT, width / height, near, far), lookAt(eye, view.target, [0, 1, 0]));
    setUniforms(gl, this.programs.scan, {
      matrix: ["Matrix4fv", matrix], eye: ["3fv", eye], up: ["3fv", up], low: ["3fv", box.low], high: ["3fv", box.high],
      coloured: ["1i", coloured && this.mesh.colour ? 1 : 0],
    });
    gl.bindVertexArray(this.surface);
    drawIndices(gl, gl.TRIANGLES, this.triangles);
    gl.bindVertexArray(this.marks);
    for (const { points, colour, size } of marks) {
      gl.bindBuffer(gl.ARRAY_BUFFER, this.places);
      gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(points.flat()), gl.DYNAMIC_DRAW);
      setUniforms(gl, this.programs.mark, {
        matrix: ["Matrix4fv", matrix], eye: ["3fv", eye], colour: ["3fv", colour], size: ["1f", size * ratio],
        lift: ["1f", view.distance / 200],
      });
      gl.drawArrays(gl.POINTS, 0, points.length);
    }
    gl.bindVertexArray(null);
  }
}
