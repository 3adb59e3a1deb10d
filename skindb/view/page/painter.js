// Draws one face, or the original and the edited face side by side, into a canvas.
"use strict";

const COARSE_MM = 2.3, CASTER_MM = 5;  // between vertices of faces and shadows while something moves without a graphics card
const SHADOW_SIZE = 1024, GLOW_SIZE = 384, COARSE_GLOW_SIZE = 128, LIGHT_WIDTH = 512, FACE_HEIGHT_OVER_WIDTH = 1.5;

// lights in groups of at most the number that one pass can process
function batches(lights) {
  const out = [];
  for (let i = 0; i < lights.length; i += MAX_LIGHTS) out.push(lights.slice(i, i + MAX_LIGHTS));
  return out;
}

class Painter {
  constructor(canvas) {
    this.canvas = canvas;
    this.software = isSoftware();
    const gl = canvas.getContext("webgl2", { antialias: !this.software, preserveDrawingBuffer: true });
    if (!gl) throw new Error("This browser has no WebGL2.");
    this.gl = gl;
    this.prepare();
  }

  prepare() {
    const gl = this.gl;
    this.floats = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float");
    this.programs = Object.fromEntries(Object.keys(SHADERS).map((name) => [name, compile(gl, name)]));
    this.programs.faceOfMany = compile(gl, "face", "SECOND_TABLE");
    this.programs.lightOfMany = compile(gl, "light", "SECOND_TABLE");
    this.programs.irradianceAtVertices = compile(gl, "irradiance", "AT_VERTICES");
    this.shadow = shadowTarget(gl, SHADOW_SIZE, MAX_LIGHTS);
    this.glows = {};
    this.empty = gl.createVertexArray();
    this.sides = {};
    this.points = this.caster = this.light = this.sum = this.sums = this.tableA = this.tableB = this.lobes = this.mirror = this.detail = null;
  }

  load(face) {
    const gl = this.gl, names = face.traits.length ? ["plain", "edited"] : ["plain"];
    this.shadowed = [];
    this.differ = false;
    this.drawn = this.sky = "";
    this.sum = null;
    for (const side of Object.values(this.sides)) {
      gl.deleteVertexArray(side.vao);
      side.buffers.forEach((one) => gl.deleteBuffer(one));
    }
    this.face = face;
    this.visible = new VisibleTriangles(face);
    if (this.software) this.loadCoarse(face);
    for (const name of ["tableA", "tableB", "lobes", "detail"]) if (this[name]) gl.deleteTexture(this[name]);
    this.open = face.transfer.reduce((most, value, i) => (i % 16 ? most : Math.max(most, value)), 0);
    this.sides = Object.fromEntries(names.map((name) => [name, this.side(face)]));
    this.tableA = table3d(gl, face.tableShape, face.tableA);
    this.tableB = face.tableB ? table3d(gl, face.tableShape, face.tableB) : this.tableA;
    this.detail = face.detail ? detailTexture(gl, face.detail) : null;
    this.lobes = halfTexture(gl, face.tableLobes.length / 8, 2, gl.HALF_FLOAT, face.tableLobes);
  }

  loadCoarse(face) {
    const gl = this.gl;
    this.coarse = new VisibleTriangles({ ...face, triangles: fewerTriangles(face, COARSE_MM) });
    for (const one of [this.points, this.caster]) if (one) gl.deleteBuffer(one.buffer);
    this.points = indices(gl, this.coarse.corners.sort());
    this.caster = indices(gl, fewerTriangles(face, CASTER_MM));
    if (this.light) deleteTarget(gl, this.light);
    this.light = target(gl, LIGHT_WIDTH, Math.ceil(face.spacing.length / LIGHT_WIDTH));
  }

  side(face) {
    const gl = this.gl, vao = gl.createVertexArray();
    gl.bindVertexArray(vao);
    const buffers = [
      ...VALUES.map((name, at) => buffer(gl, at, name.startsWith("weight") ? 4 : 3, face[name])),
      buffer(gl, 6, 2, face.uv), buffer(gl, 7, 1, face.spacing), buffer(gl, 8, 2, face.quality), buffer(gl, 9, 16, face.transfer),
    ];
    const index = indices(gl, face.triangles), none = new Uint32Array();
    const list = indices(gl, none), points = indices(gl, none);  // what the view shows
    for (const one of [index, list, points]) buffers.push(one.buffer);
    return { vao, buffers, index, list, points, visible: [this.visible, this.coarse], values: face, seen: "", glow: {}, spread: 0 };
  }

  // Changes the values of the edited side; `differ` is whether it differs from the plain one.
  update(values, differ) {
    const gl = this.gl, side = this.sides.edited, changed = VALUES.filter((name) => values[name] !== side.values[name]);
    this.differ = differ;
    this.sum = null;
    for (const name of changed) {
      gl.bindBuffer(gl.ARRAY_BUFFER, side.buffers[VALUES.indexOf(name)]);
      gl.bufferSubData(gl.ARRAY_BUFFER, 0, values[name]);
    }
    side.values = values;
    if (changed.some((name) => ["position", "normal", "diffusion"].includes(name))) Object.assign(side, { glow: { ...side.glow, lit: "" }, spread: 0 });
    if (!changed.includes("position")) return;
    side.visible = this.isMoved() ? [null, null] : [this.visible, this.coarse];
    side.seen = "";
    this.shadowed = [];
  }

  isMoved() { return this.sides.edited && this.sides.edited.values.position !== this.face.position; }

  // Waits until what was drawn is finished.
  finish() { this.gl.readPixels(0, 0, 1, 1, this.gl.RGBA, this.gl.UNSIGNED_BYTE, new Uint8Array(4)); }

  // Draws a picture, or the next part of a picture in an environment; returns the fraction that is done. With
  // `coarse`, while something moves, the environment has a smooth reflection and, without a graphics card, the face has
  // fewer vertices, at which light is computed, and light under the skin fewer texels; the side before the divider stays
  // while only the edit changes.
  draw(state, coarse = false) {
    const gl = this.gl, { width, height } = this.canvas, lights = state.lights.slice(0, MAX_LIGHTS);
    if (!this.face || gl.isContextLost()) return 1;
    this.updateSky(state.around);
    const shown = { lights, sums: null, mirror: state.around.on, coarse: coarse && this.software && this.floats !== null };
    const asked = JSON.stringify([state, width, height, coarse], (key, value) => (key === "inputs" ? 0 : value));
    const isSum = state.around.on && state.withSurface && !state.component && this.floats && !coarse;
    if (!isSum || !this.sum || this.sum.asked !== asked) {
      const first = shown.coarse && this.differ && this.drawn === asked ? this.cut(state) : 0;
      this.clear(null, state.background, first);
      this.drawSides(state, shown, first);
      this.drawn = this.differ ? asked : "";
      this.sum = { asked, done: -1 };
      return isSum ? 0 : 1;
    }
    return this.sum.done === batches(this.distant).length ? 1 : this.drawSum(state, shown);
  }

  // column of the divider
  cut(state) { return this.differ ? Math.round(state.divider * this.canvas.width) : this.canvas.width; }

  clear(frame, background, first = 0) {
    const gl = this.gl, { width, height } = this.canvas;
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.viewport(0, 0, width, height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(first, 0, width - first, height);
    gl.clearColor(...(background || [0, 0, 0]), background ? 1 : 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.disable(gl.SCISSOR_TEST);
  }

  // Adds the reflection of four lights of the environment, and shows the picture when it has all.
  drawSum(state, shown) {
    const gl = this.gl, parts = batches(this.distant), { sum } = this;
    if (sum.done < 0) {
      this.beginSum();
      this.drawSides(state, { ...shown, sums: this.sums, mirror: false });
    } else {
      this.drawSides({ ...state, withDiffuse: false, softness: 1 }, { ...shown, lights: parts[sum.done], sums: this.sums, mirror: false });
    }
    sum.done += 1;
    if (sum.done === parts.length) {
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      gl.viewport(0, 0, this.canvas.width, this.canvas.height);
      gl.disable(gl.DEPTH_TEST);
      this.bindTextures([[gl.TEXTURE_2D, null], [gl.TEXTURE_2D, this.sums.texture]]);
      setUniforms(gl, this.programs.shown, {
        source: ["1i", 1], background: ["4fv", state.background ? [...state.background, 1] : [0, 0, 0, 0]], toned: ["1i", state.toned ? 1 : 0],
      });
      gl.bindVertexArray(this.empty);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
      return 1;
    }
    return (sum.done + 1) / (parts.length + 1);
  }

  beginSum() {
    const gl = this.gl, { width, height } = this.canvas;
    if (!this.sums || this.sums.width !== width || this.sums.height !== height) {
      if (this.sums) deleteTarget(gl, this.sums);
      this.sums = sumTarget(gl, width, height);
    }
    gl.depthMask(true);
    this.clear(this.sums.frame, null);
  }

  // the harmonics of the environment and its mirror image
  updateSky(around) {
    const sky = JSON.stringify(around), gl = this.gl;
    if (sky === this.sky) return;
    this.sky = sky;
    this.distant = around.on ? distantLights(this.face, around) : [];
    this.harmonics = skyHarmonics(this.distant);
    gl.deleteTexture(this.mirror);
    this.mirror = halfTexture(gl, MIRROR.width, MIRROR.height, gl.FLOAT, mirrorImage(this.distant));
  }

  // Draws the sides of the divider from a column under some lights, into the canvas or added to a sum.
  drawSides(state, shown, first = 0) {
    const gl = this.gl, { width, height } = this.canvas, { sums, lights } = shown;
    const { uniforms, matrices } = this.lightUniforms(lights, state);
    const cut = this.cut(state);
    for (const [name, left, size] of [["plain", 0, cut], ["edited", cut, width - cut]]) {
      if (size <= 0 || left < first) continue;
      if (!state.component) this.drawShadows(matrices, this.isMoved() ? name : "plain", shown.coarse);
      const glow = state.glow && this.floats && state.withDiffuse && !state.component ? this.glow(name, uniforms, shown, state) : null;
      gl.bindFramebuffer(gl.FRAMEBUFFER, sums ? sums.frame : null);
      gl.viewport(0, 0, width, height);
      gl.enable(gl.SCISSOR_TEST);
      gl.scissor(left, 0, size, height);
      const span = [left, left + size].map((column) => (2 * column) / width - 1);
      const view = { ...shown, uniforms, glow, span };
      if (sums && this.sum.done < 0) {  // depths first, so that every pixel is added once
        gl.colorMask(false, false, false, false);
        this.drawFace(name, state, view);
        gl.colorMask(true, true, true, true);
      }
      if (sums) {
        gl.depthFunc(gl.EQUAL);
        gl.depthMask(false);
        gl.enable(gl.BLEND);
        gl.blendFunc(gl.ONE, gl.ONE);
      }
      this.drawFace(name, state, view);
      gl.depthFunc(gl.LESS);
      gl.depthMask(true);
      gl.disable(gl.BLEND);
      gl.disable(gl.SCISSOR_TEST);
    }
  }

  lightUniforms(lights, state) {
    const { centre, radius } = this.face, matrices = [];
    const position = new Float32Array(3 * MAX_LIGHTS), intensity = new Float32Array(3 * MAX_LIGHTS);
    const all = new Float32Array(16 * MAX_LIGHTS);
    lights.forEach((light, i) => {
      const place = light.position || add(centre, direction(light.azimuth, light.elevation), light.distance);
      const distance = Math.hypot(...sub(place, centre));
      const tangent = Math.tan(Math.asin(Math.min(radius / distance, 0.99)));
      const up = Math.abs(unit(sub(place, centre))[1]) > 0.95 ? [0, 0, 1] : [0, 1, 0];
      const view = lookAt(place, centre, up);
      const matrix = product(perspective(tangent, 1, Math.max(distance - radius, 1), distance + radius), view);
      matrices.push(matrix);
      position.set(place, 3 * i);
      intensity.set(light.intensity.map((x) => x * light.power), 3 * i);
      all.set(matrix, 16 * i);
    });
    const uniforms = {
      lightCount: ["1i", lights.length], lightPosition: ["3fv", position], lightIntensity: ["3fv", intensity],
      lightMatrix: ["Matrix4fv", all], shadowMap: ["1i", 0], eta: ["1f", this.face.eta], shadowRadius: ["1f", state.softness],
      singleTap: ["1i", this.software && !state.fine ? 1 : 0], sky: ["Matrix4x3fv", this.harmonics], open: ["1f", this.open],
    };
    return { uniforms, matrices };
  }

  bindTextures(textures) {
    const gl = this.gl;
    textures.forEach(([kind, texture], i) => { gl.activeTexture(gl.TEXTURE0 + i); gl.bindTexture(kind, texture); });
  }

  // Draws the shadow maps of lights that have moved, or of another shape.
  drawShadows(matrices, name, coarse) {
    const gl = this.gl, side = this.sides[name];
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.shadow.frame);
    gl.viewport(0, 0, SHADOW_SIZE, SHADOW_SIZE);
    gl.enable(gl.DEPTH_TEST);
    gl.disable(gl.CULL_FACE);
    gl.bindVertexArray(side.vao);
    matrices.forEach((matrix, i) => {
      const fine = name + matrix, fewer = `coarse ${fine}`;
      if (this.shadowed[i] === fine || (coarse && this.shadowed[i] === fewer)) return;
      this.shadowed[i] = coarse ? fewer : fine;
      gl.framebufferTextureLayer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, this.shadow.texture, 0, i);
      gl.clear(gl.DEPTH_BUFFER_BIT);
      setUniforms(gl, this.programs.depth, { matrix: ["Matrix4fv", matrix] });
      drawIndices(gl, gl.TRIANGLES, coarse ? this.caster : side.index);
    });
  }

  // Light under the skin of a side as a texture. Sides with equal shape and translucency share it, and it stays the
  // same while only the view turns; while something moves, it may be that of the frame before.
  glow(name, uniforms, { lights, coarse }, state) {
    const { values } = this.sides[name], shares = ["position", "normal", "diffusion"].every((one) => values[one] === this.face[one]);
    const side = this.sides[shares ? "plain" : name], size = coarse ? COARSE_GLOW_SIZE : GLOW_SIZE;
    const lit = JSON.stringify([lights.map(({ inputs, ...rest }) => rest), state.softness, this.sky]);
    const current = side.glow.lit === lit && side.glow.size >= size;
    if (current || (coarse && side.glow.drawnLast)) side.glow.drawnLast = false;
    else {
      this.drawGlow(side, uniforms, size);
      side.glow = { lit, size, texture: side.blurred.texture, drawnLast: coarse };
    }
    return side.glow.texture;
  }

  drawGlow(side, uniforms, size) {
    const gl = this.gl, { face } = this;
    this.glows[size] = this.glows[size] || ["irradiance", "across"].map(() => target(gl, size));
    side.targets = side.targets || {};
    side.targets[size] = side.targets[size] || ["radius", "blurred"].map(() => target(gl, size));
    const [light, across] = this.glows[size], [radius, blurred] = side.targets[size];
    side.blurred = blurred;
    gl.disable(gl.DEPTH_TEST);
    gl.disable(gl.CULL_FACE);
    gl.viewport(0, 0, size, size);
    this.bindTextures([[gl.TEXTURE_2D_ARRAY, this.shadow.texture]]);
    gl.bindVertexArray(side.vao);
    const coarse = size === COARSE_GLOW_SIZE, passes = [[light, coarse ? "irradianceAtVertices" : "irradiance", uniforms]];
    if (side.spread !== size) passes.push([radius, "radius", { width: ["3fv", face.diffusionWidth.map((x) => x * size)] }]);
    side.spread = size;
    for (const [to, program, values] of passes) {
      gl.bindFramebuffer(gl.FRAMEBUFFER, to.frame);
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT);
      setUniforms(gl, this.programs[program], values);
      if (coarse) drawIndices(gl, gl.POINTS, this.points);
      else drawIndices(gl, gl.TRIANGLES, side.index);
    }
    gl.bindVertexArray(this.empty);
    for (const [from, to, along] of [[light, across, [1, 0]], [across, blurred, [0, 1]]]) {
      gl.bindFramebuffer(gl.FRAMEBUFFER, to.frame);
      this.bindTextures([[gl.TEXTURE_2D_ARRAY, this.shadow.texture], [gl.TEXTURE_2D, from.texture], [gl.TEXTURE_2D, radius.texture]]);
      setUniforms(gl, this.programs.blur, { source: ["1i", 1], radius: ["1i", 2], along: ["2fv", along] });
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
  }

  // `span` is the part of the picture that is drawn, as horizontal places from -1 to 1
  drawFace(name, state, { uniforms, glow, sums, mirror, span, coarse }) {
    const gl = this.gl, { width, height } = this.canvas, { face } = this;
    const { through } = state, eye = through ? through.eye : state.eye || add(face.centre, direction(state.azimuth, state.elevation), state.distance);
    const reach = Math.hypot(...sub(eye, face.centre));
    const near = Math.max(reach - 1.2 * face.radius, 1), far = reach + 1.2 * face.radius;
    const tangent = state.tangent / Math.min(1, (FACE_HEIGHT_OVER_WIDTH * width) / height);  // a narrow picture shows the whole face
    const matrix = through
      ? throughCamera(through, this.canvas, near, far)
      : product(perspective(tangent, width / height, near, far), lookAt(eye, state.target || face.centre, [0, 1, 0]));
    this.bindTextures([
      [gl.TEXTURE_2D_ARRAY, this.shadow.texture], [gl.TEXTURE_3D, this.tableA], [gl.TEXTURE_3D, this.tableB],
      [gl.TEXTURE_2D, glow], [gl.TEXTURE_2D, this.mirror], [gl.TEXTURE_2D, this.lobes],
      [gl.TEXTURE_2D, this.detail],
    ]);
    const values = {
      ...uniforms, source: ["1i", 1], matrix: ["Matrix4fv", matrix], eye: ["3fv", eye], exposure: ["1f", state.exposure * face.exposure],
      tableA: ["1i", 1], tableB: ["1i", 2], glow: ["1i", 3], mirror: ["1i", 4], lobes: ["1i", 5], detail: ["1i", 6], withDetail: ["1i", face.detail ? 1 : 0],
      withDiffuse: ["1i", state.withDiffuse ? 1 : 0], withSurface: ["1i", state.withSurface ? 1 : 0],
      withGlow: ["1i", glow ? 1 : 0], withMirror: ["1i", mirror ? 1 : 0],
      linear: ["1i", sums ? 1 : 0], toned: ["1i", state.toned ? 1 : 0], component: ["1i", state.component],
    };
    const side = this.sides[name], atVertices = coarse && !state.component, many = face.tableB ? "OfMany" : "";
    this.selectVisible(side, eye, matrix, span, coarse);
    gl.bindVertexArray(side.vao);
    if (atVertices) this.drawLight(this.programs[`light${many}`], values, side.points);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.CULL_FACE);
    setUniforms(gl, this.programs[state.component ? "components" : atVertices ? "coarse" : `face${many}`], values);
    drawIndices(gl, gl.TRIANGLES, side.list);
    gl.bindVertexArray(null);
  }

  // Computes the radiance of the vertices that are drawn while something moves, into a texture for the program `coarse`.
  // Each is computed once, but pixels of triangles of their size several times without a graphics card.
  drawLight(program, values, points) {
    const gl = this.gl, { frame, texture, width, height } = this.light;
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.viewport(0, 0, width, height);
    for (const one of [gl.DEPTH_TEST, gl.CULL_FACE, gl.SCISSOR_TEST]) gl.disable(one);
    setUniforms(gl, program, { ...values, size: ["2iv", [width, height]] });
    drawIndices(gl, gl.POINTS, points);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.enable(gl.SCISSOR_TEST);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, texture);
  }

  // lists the triangles of a side that the view shows, and their vertices for `drawLight`
  selectVisible(side, eye, matrix, span, coarse) {
    const gl = this.gl, asked = [...matrix, ...span, coarse].join(), which = coarse ? 1 : 0;
    if (side.seen === asked) return;
    side.seen = asked;
    side.visible[which] = side.visible[which] || new VisibleTriangles({ ...this[coarse ? "coarse" : "visible"], position: side.values.position });
    const list = side.visible[which].select(eye, matrix, ...span), shown = new Uint8Array(this.face.spacing.length);
    side.list = indices(gl, list, side.list.buffer);
    if (!coarse) return;
    for (const i of list) shown[i] = 1;
    side.points = indices(gl, this.coarse.corners.filter((i) => shown[i]), side.points.buffer);
  }
}
