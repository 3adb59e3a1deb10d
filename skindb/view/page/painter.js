// Draws one face, or the original and the edited face side by side, into a canvas.
"use strict";

const SHADOW_SIZE = 1024, GLOW_SIZE = 384;

// lights in groups of at most the number that one pass can process
function batches(lights) {
  const out = [];
  for (let i = 0; i < lights.length; i += MAX_LIGHTS) out.push(lights.slice(i, i + MAX_LIGHTS));
  return out;
}

// total power of a group of lights, in an arbitrary unit
function power(lights) {
  return lights.reduce((sum, light) => sum + (light.weight ?? light.power), 0);
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
    this.shadow = shadowTarget(gl, SHADOW_SIZE, MAX_LIGHTS);
    this.glows = this.floats ? ["irradiance", "across", "radius"].map(() => target(gl, GLOW_SIZE)) : null;
    this.empty = gl.createVertexArray();
    this.sides = {};
    this.blurred = {};
    this.fresh = {};
    this.sum = this.sums = null;
    this.edits = 0;  // counts changes of the face by traits
  }

  load(face) {
    const gl = this.gl, names = face.traits.length ? ["plain", "edited"] : ["plain"];
    this.lit = this.shadowed = "";
    this.differ = this.moved = false;
    this.fresh = {};
    this.sum = null;
    for (const side of Object.values(this.sides)) {
      gl.deleteVertexArray(side.vao);
      side.buffers.forEach((one) => gl.deleteBuffer(one));
    }
    this.face = face;
    this.visible = new VisibleTriangles(face);
    this.sides = Object.fromEntries(names.map((name) => [name, this.side(face)]));
    for (const name of ["tableA", "tableB"]) if (this[name]) gl.deleteTexture(this[name]);
    this.tableA = table3d(gl, face.tableShape, face.tableA);
    this.tableB = face.tableB ? table3d(gl, face.tableShape, face.tableB) : this.tableA;
  }

  side(face) {
    const gl = this.gl, vao = gl.createVertexArray();
    gl.bindVertexArray(vao);
    const buffers = [
      ...VALUES.map((name, at) => buffer(gl, at, name.startsWith("weight") ? 4 : 3, gl.FLOAT, face[name])),
      buffer(gl, 6, 2, gl.FLOAT, face.uv), buffer(gl, 7, 1, gl.FLOAT, face.spacing),
      buffer(gl, 8, 2, gl.FLOAT, face.quality),
    ];
    const index = gl.createBuffer();
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, index);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, face.triangles, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    const list = gl.createBuffer();  // of the visible triangles, made again for each view
    return { vao, buffers: [...buffers, index, list], index, list, visible: this.visible, seen: "", size: 0 };
  }

  // `differ` is whether this side differs from the plain one
  update(name, values, differ) {
    this.edits += 1;
    this.differ = differ;
    this.fresh[name] = false;
    const gl = this.gl, side = this.sides[name];
    if (!side) return;
    VALUES.forEach((name, at) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, side.buffers[at]);
      gl.bufferSubData(gl.ARRAY_BUFFER, 0, values[name]);
    });
    const { position, triangles } = this.face;
    this.moved = values.position.some((x, i) => x !== position[i]);
    side.visible = this.moved ? new VisibleTriangles({ position: values.position, triangles }) : this.visible;
    side.seen = this.shadowed = "";
  }

  // Draws a picture, or the next part of a picture under many lights; returns the fraction of the picture that is done.
  draw(state) {
    const gl = this.gl;
    if (!this.face || gl.isContextLost()) return 1;
    const lights = state.lights.slice(0, MAX_LIGHTS);
    if (state.surroundings && state.surroundings.length && !state.component && this.floats) {
      return this.drawSum(state, [...(lights.length ? [lights] : []), ...batches(state.surroundings)]);
    }
    this.sum = null;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.clearColor(...state.background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    this.drawSides(state, lights, null);
    return 1;
  }

  // Adds four lights at a time, so that many lights take more time but no other code.
  drawSum(state, parts) {
    const gl = this.gl, { width, height } = this.canvas;
    const asked = JSON.stringify([{ ...state, background: 0 }, this.edits, width, height], (key, value) => (key === "inputs" ? 0 : value));
    if (!this.sum || this.sum.asked !== asked) this.beginSum(asked);
    if (this.sum.done < parts.length) {
      this.drawSides(state, parts[this.sum.done], this.sums);
      this.sum.done += 1;
      this.sum.power += power(parts[this.sum.done - 1]);
    }
    const whole = parts.reduce((sum, part) => sum + power(part), 0);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.disable(gl.DEPTH_TEST);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, this.sums.texture);
    const gain = this.sum.power > 0 ? whole / this.sum.power : 1;  // a preview of the picture before it is complete
    setUniforms(gl, this.programs.shown, { source: ["1i", 1], gain: ["1f", gain], background: ["3fv", state.background] });
    gl.bindVertexArray(this.empty);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    return this.sum.done / parts.length;
  }

  beginSum(asked) {
    const gl = this.gl, { width, height } = this.canvas;
    if (!this.sums || this.sums.width !== width || this.sums.height !== height) {
      if (this.sums) {
        gl.deleteTexture(this.sums.texture);
        gl.deleteRenderbuffer(this.sums.depth);
        gl.deleteFramebuffer(this.sums.frame);
      }
      this.sums = sumTarget(gl, width, height);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.sums.frame);
    gl.depthMask(true);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    this.sum = { asked, done: 0, power: 0 };
  }

  // Draws both sides of the divider under some lights, into the canvas or added to a sum.
  drawSides(state, lights, sums) {
    const gl = this.gl, { width, height } = this.canvas, { uniforms, matrices } = this.lightUniforms(lights, state);
    // shadows and light under the skin do not change while only the view turns
    const lit = JSON.stringify([lights.map(({ inputs, ...rest }) => rest), state.softness]);
    if (lit !== this.lit) this.fresh = {};
    this.lit = lit;
    const cut = this.differ ? Math.round(state.divider * width) : width;
    const parts = [["plain", 0, cut], ["edited", cut, width - cut]];
    for (const [name, left, size] of parts) {
      if (size <= 0) continue;
      const shape = this.moved ? name : "plain";
      if (this.shadowed !== lit + shape) this.drawShadows(matrices, shape);
      this.shadowed = lit + shape;
      const glow = state.glow && this.glows && state.withDiffuse;
      if (glow && !this.fresh[name]) this.drawGlow(name, uniforms);
      this.fresh[name] = this.fresh[name] || glow;
      gl.bindFramebuffer(gl.FRAMEBUFFER, sums ? sums.frame : null);
      gl.viewport(0, 0, width, height);
      gl.enable(gl.SCISSOR_TEST);
      gl.scissor(left, 0, size, height);
      const span = [left, left + size].map((column) => (2 * column) / width - 1);
      if (sums && this.sum.done === 0) {  // depths first, so that every pixel is added once
        gl.colorMask(false, false, false, false);
        this.drawFace(name, state, uniforms, glow, true, span);
        gl.colorMask(true, true, true, true);
      }
      if (sums) {
        gl.depthFunc(gl.EQUAL);
        gl.depthMask(false);
        gl.enable(gl.BLEND);
        gl.blendFunc(gl.ONE, gl.ONE);
      }
      this.drawFace(name, state, uniforms, glow, Boolean(sums), span);
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
      lightMatrix: ["mat4", all], shadowMap: ["1i", 0], eta: ["1f", this.face.eta], shadowRadius: ["1f", state.softness],
      singleTap: ["1i", this.software && !state.fine ? 1 : 0],
    };
    return { uniforms, matrices };
  }

  drawShadows(matrices, name) {
    const gl = this.gl, side = this.sides[name];
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.shadow.frame);
    gl.viewport(0, 0, SHADOW_SIZE, SHADOW_SIZE);
    gl.enable(gl.DEPTH_TEST);
    gl.disable(gl.CULL_FACE);
    gl.bindVertexArray(side.vao);
    matrices.forEach((matrix, i) => {
      gl.framebufferTextureLayer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, this.shadow.texture, 0, i);
      gl.clear(gl.DEPTH_BUFFER_BIT);
      setUniforms(gl, this.programs.depth, { matrix: ["mat4", matrix] });
      gl.drawElements(gl.TRIANGLES, this.face.triangles.length, gl.UNSIGNED_INT, 0);
    });
  }

  drawGlow(name, uniforms) {
    const gl = this.gl, [light, across, radius] = this.glows, { face } = this;
    const blurred = (this.blurred[name] = this.blurred[name] || target(gl, GLOW_SIZE));
    gl.disable(gl.DEPTH_TEST);
    gl.disable(gl.CULL_FACE);
    gl.viewport(0, 0, GLOW_SIZE, GLOW_SIZE);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, this.shadow.texture);
    gl.bindVertexArray(this.sides[name].vao);
    for (const [to, program, values] of [
      [radius, "radius", { width: ["3fv", face.diffusionWidth.map((x) => x * GLOW_SIZE)] }],
      [light, "irradiance", uniforms],
    ]) {
      gl.bindFramebuffer(gl.FRAMEBUFFER, to.frame);
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT);
      setUniforms(gl, this.programs[program], values);
      gl.drawElements(gl.TRIANGLES, face.triangles.length, gl.UNSIGNED_INT, 0);
    }
    gl.bindVertexArray(this.empty);
    for (const [from, to, along] of [[light, across, [1, 0]], [across, blurred, [0, 1]]]) {
      gl.bindFramebuffer(gl.FRAMEBUFFER, to.frame);
      gl.activeTexture(gl.TEXTURE1);
      gl.bindTexture(gl.TEXTURE_2D, from.texture);
      gl.activeTexture(gl.TEXTURE2);
      gl.bindTexture(gl.TEXTURE_2D, radius.texture);
      setUniforms(gl, this.programs.blur, { source: ["1i", 1], radius: ["1i", 2], along: ["2fv", along] });
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
  }

  // `span` is the part of the picture that is drawn, as horizontal places from -1 to 1
  drawFace(name, state, lights, glow, linear, span) {
    const gl = this.gl, { width, height } = this.canvas, { face } = this;
    const eye = state.eye || add(face.centre, direction(state.azimuth, state.elevation), state.distance);
    const reach = Math.hypot(...sub(eye, face.centre));
    const near = Math.max(reach - 1.2 * face.radius, 1), far = reach + 1.2 * face.radius;
    const matrix = product(perspective(state.tangent, width / height, near, far), lookAt(eye, state.target || face.centre, [0, 1, 0]));
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.CULL_FACE);
    const textures = [
      [gl.TEXTURE_2D_ARRAY, this.shadow.texture], [gl.TEXTURE_3D, this.tableA], [gl.TEXTURE_3D, this.tableB],
      [gl.TEXTURE_2D, glow ? this.blurred[name].texture : null],
    ];
    textures.forEach(([kind, texture], i) => { gl.activeTexture(gl.TEXTURE0 + i); gl.bindTexture(kind, texture); });
    const program = state.component ? "components" : face.tableB ? "faceOfMany" : "face";
    setUniforms(gl, this.programs[program], {
      ...lights, matrix: ["mat4", matrix], eye: ["3fv", eye], exposure: ["1f", state.exposure * face.exposure],
      tableA: ["1i", 1], tableB: ["1i", 2], glow: ["1i", 3],
      withDiffuse: ["1i", state.withDiffuse ? 1 : 0], withSurface: ["1i", state.withSurface ? 1 : 0],
      withGlow: ["1i", glow ? 1 : 0], linear: ["1i", linear ? 1 : 0], component: ["1i", state.component],
    });
    const side = this.sides[name];
    gl.bindVertexArray(side.vao);
    this.selectVisible(side, eye, matrix, span);
    gl.drawElements(gl.TRIANGLES, side.size, gl.UNSIGNED_INT, 0);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, side.index);
    gl.bindVertexArray(null);
  }

  // binds the list of the triangles of a side that the view shows
  selectVisible(side, eye, matrix, span) {
    const gl = this.gl, asked = [...matrix, ...span].join();
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, side.list);
    if (side.seen === asked) return;
    const list = side.visible.select(eye, matrix, ...span);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, list, gl.DYNAMIC_DRAW);
    Object.assign(side, { seen: asked, size: list.length });
  }
}
