// Vectors and 4 x 4 matrices, in column-major order as in WebGL.
"use strict";

const sub = (a, b) => a.map((x, i) => x - b[i]);
const add = (a, b, s = 1) => a.map((x, i) => x + s * b[i]);
const dot = (a, b) => a.reduce((sum, x, i) => sum + x * b[i], 0);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => { const d = Math.hypot(...a) || 1; return a.map((x) => x / d); };

function product(a, b) {
  const out = new Float32Array(16);
  for (let c = 0; c < 4; c++)
    for (let r = 0; r < 4; r++)
      for (let k = 0; k < 4; k++) out[4 * c + r] += a[4 * k + r] * b[4 * c + k];
  return out;
}

function lookAt(eye, centre, up) {
  const z = unit(sub(eye, centre)), x = unit(cross(up, z)), y = cross(z, x);
  return new Float32Array([x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0, -dot(x, eye), -dot(y, eye), -dot(z, eye), 1]);
}

function perspective(tangent, aspect, near, far) {
  const f = 1 / tangent, d = near - far;
  return new Float32Array([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / d, -1, 0, 0, (2 * far * near) / d, 0]);
}

// Projection and view of a calibrated camera, whose picture fits into a canvas. Its rows point downwards, and z forward.
function throughCamera({ K, R, t, width, height }, canvas, near, far) {
  const fit = fitted({ width, height }, canvas), [x, y] = [2 / canvas.width, 2 / canvas.height], d = far - near;
  const projection = new Float32Array([
    x * fit.scale * K[0][0], 0, 0, 0, x * fit.scale * K[0][1], -y * fit.scale * K[1][1], 0, 0,
    x * (fit.scale * K[0][2] + fit.left) - 1, 1 - y * (fit.scale * K[1][2] + fit.top), (far + near) / d, 1, 0, 0, (-2 * far * near) / d, 0,
  ]);
  const view = new Float32Array([0, 1, 2].flatMap((c) => [R[0][c], R[1][c], R[2][c], 0]).concat(t, 1));
  return product(projection, view);
}

// place of a picture that fits into the middle of another
function fitted(inner, outer) {
  const scale = Math.min(outer.width / inner.width, outer.height / inner.height);
  return { scale, left: (outer.width - scale * inner.width) / 2, top: (outer.height - scale * inner.height) / 2 };
}

// direction from the middle of the face; 0, 0 is the front, and angles are in degrees to the subject's left and upwards
function direction(azimuth, elevation) {
  const a = (azimuth * Math.PI) / 180, e = (elevation * Math.PI) / 180;
  return [Math.cos(e) * Math.sin(a), Math.sin(e), Math.cos(e) * Math.cos(a)];
}
