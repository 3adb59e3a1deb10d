// Programs, textures and buffers for WebGL2.
"use strict";

// whether pictures are computed without a graphics card; antialiasing, which doubles the time, is then switched off
function isSoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const about = gl && gl.getExtension("WEBGL_debug_renderer_info");
  const name = gl ? gl.getParameter(about ? about.UNMASKED_RENDERER_WEBGL : gl.RENDERER) : "";
  const loss = gl && gl.getExtension("WEBGL_lose_context");
  if (loss) loss.loseContext();
  return /swiftshader|llvmpipe|software/i.test(String(name));
}

function compile(gl, name, ...defines) {
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, SHADERS[name].vertex], [gl.FRAGMENT_SHADER, SHADERS[name].fragment]]) {
    const shader = gl.createShader(kind), source = text.replace("\n", `\n${defines.map((one) => `#define ${one}\n`).join("")}`);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
    const logs = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader));
    throw new Error(`shader ${name}: ${gl.getProgramInfoLog(program)} ${logs.join(" ")}`);
  }
  const uniforms = {};
  const count = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS) || 0;
  for (let i = 0; i < count; i++) {
    const about = gl.getActiveUniform(program, i);
    uniforms[about.name.replace("[0]", "")] = gl.getUniformLocation(program, about.name);
  }
  return { program, uniforms };
}

function setUniforms(gl, { program, uniforms }, values) {
  gl.useProgram(program);
  for (const [name, [kind, value]] of Object.entries(values)) {
    if (!(name in uniforms)) continue;
    if (kind.startsWith("Matrix")) gl[`uniform${kind}`](uniforms[name], false, value);
    else gl[`uniform${kind}`](uniforms[name], value);
  }
}

function table3d(gl, [depth, height, width], halves) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_3D, texture);
  gl.texImage3D(gl.TEXTURE_3D, 0, gl.RGBA16F, width, height, depth, 0, gl.RGBA, gl.HALF_FLOAT, halves);
  for (const axis of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_3D, axis, gl.CLAMP_TO_EDGE);
  gl.texParameteri(gl.TEXTURE_3D, gl.TEXTURE_WRAP_R, gl.REPEAT);  // phi_d is periodic
  gl.texParameteri(gl.TEXTURE_3D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
  gl.texParameteri(gl.TEXTURE_3D, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
  return texture;
}

function halfTexture(gl, width, height, type, values) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16F, width, height, 0, gl.RGBA, type, values);
  for (const axis of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, axis, gl.CLAMP_TO_EDGE);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
  return texture;
}

// bytes (2 n, n, 3) with smaller copies for a face that is far away
function detailTexture(gl, bytes) {
  const texture = gl.createTexture(), width = Math.sqrt(bytes.length / 6);
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, width, 2 * width, 0, gl.RGB, gl.UNSIGNED_BYTE, bytes);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 4);
  gl.generateMipmap(gl.TEXTURE_2D);
  for (const axis of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, axis, gl.CLAMP_TO_EDGE);
  return texture;
}

function target(gl, width, height = width) {
  const texture = halfTexture(gl, width, height, gl.HALF_FLOAT, null);
  const frame = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
  return { texture, frame, width, height };
}

function deleteTarget(gl, { texture, frame, depth = null }) {
  gl.deleteTexture(texture);
  gl.deleteFramebuffer(frame);
  gl.deleteRenderbuffer(depth);
}

// half floats of the size of the picture with a depth buffer, in which passes are summed
function sumTarget(gl, width, height) {
  const texture = gl.createTexture(), depth = gl.createRenderbuffer(), frame = gl.createFramebuffer();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA16F, width, height);
  gl.bindRenderbuffer(gl.RENDERBUFFER, depth);
  gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, width, height);
  gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
  gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, depth);
  return { texture, depth, frame, width, height };
}

function shadowTarget(gl, size, layers) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D_ARRAY, texture);
  gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.DEPTH_COMPONENT24, size, size, layers);
  const options = {
    TEXTURE_WRAP_S: gl.CLAMP_TO_EDGE, TEXTURE_WRAP_T: gl.CLAMP_TO_EDGE, TEXTURE_MIN_FILTER: gl.LINEAR,
    TEXTURE_MAG_FILTER: gl.LINEAR, TEXTURE_COMPARE_MODE: gl.COMPARE_REF_TO_TEXTURE, TEXTURE_COMPARE_FUNC: gl.LEQUAL,
  };
  for (const [name, value] of Object.entries(options)) gl.texParameteri(gl.TEXTURE_2D_ARRAY, gl[name], value);
  return { texture, frame: gl.createFramebuffer(), size };
}

// values of vertices, of which each takes a location for every four numbers
function buffer(gl, location, size, values) {
  const made = gl.createBuffer();
  gl.bindBuffer(gl.ARRAY_BUFFER, made);
  gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
  for (let at = 0; at < size; at += 4) {
    gl.enableVertexAttribArray(location + at / 4);
    gl.vertexAttribPointer(location + at / 4, Math.min(size, 4), gl.FLOAT, false, 4 * size, 4 * at);
  }
  return made;
}

// numbers of vertices, for `drawIndices`
function indices(gl, values, made = gl.createBuffer()) {
  gl.bindVertexArray(null);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, made);
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, values, gl.DYNAMIC_DRAW);
  return { buffer: made, count: values.length };
}

function drawIndices(gl, kind, { buffer, count }) {
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffer);
  gl.drawElements(kind, count, gl.UNSIGNED_INT, 0);
}
