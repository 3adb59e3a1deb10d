// Decoding of the data of a page into typed arrays.
"use strict";

const VALUES = ["position", "normal", "albedo", "weightA", "weightB", "diffusion"];  // in the order of the shaders
const KINDS = { f4: Float32Array, u4: Uint32Array, u2: Uint16Array, u1: Uint8Array, f2: Uint16Array };

async function inflate(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).arrayBuffer();
}

// arrays at surfels are converted from half to single precision for arithmetic; tables stay in half precision
function single(halves) {
  const out = new Float32Array(halves.length);
  for (let i = 0; i < halves.length; i++) {
    const bits = halves[i], e = (bits >> 10) & 31, m = bits & 1023;
    out[i] = (bits & 32768 ? -1 : 1) * (e === 0 ? m * 2 ** -24 : e === 31 ? (m ? NaN : Infinity) : (1 + m / 1024) * 2 ** (e - 15));
  }
  return out;
}

async function arrays(encoded) {
  const out = {};
  for (const [name, one] of Object.entries(encoded)) {
    const values = new KINDS[one.kind](await inflate(one.data));
    out[name] = one.kind === "f2" && !name.startsWith("table") ? single(values) : values;
  }
  return out;
}

async function readFace(record) {
  const face = { ...record.about, ...(await arrays(record.arrays)) };
  face.traits = [];
  for (const trait of record.traits) face.traits.push({ ...trait, ...(await arrays(trait.arrays)) });
  return face;
}

// Values of a face edited along traits: albedo and diffusion length change exponentially, the others linearly. Arrays
// that no trait changes are those of the face.
function editedValues(face, amounts) {
  const values = {};
  for (const name of VALUES) {
    const moves = face.traits.map((trait, at) => [trait[name], amounts[at]]).filter(([move, amount]) => move && amount);
    const out = (values[name] = moves.length ? face[name].slice() : face[name]);
    const isRatio = name === "albedo" || name === "diffusion", isWeight = name.startsWith("weight");
    for (const [move, amount] of moves)
      for (let i = 0; i < out.length; i++) out[i] = isRatio ? out[i] * Math.exp(amount * move[i]) : out[i] + amount * move[i];
    if (isWeight && moves.length) for (let i = 0; i < out.length; i++) out[i] = Math.max(out[i], 0);
  }
  return values;
}
