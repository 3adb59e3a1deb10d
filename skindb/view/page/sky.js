// Light from all directions: distant lights, the spherical harmonics of their radiance, and their mirror image.
"use strict";

const MIRROR = { width: 32, height: 16, sharpness: 15 };  // exp(sharpness (cos - 1)), 15 degrees wide as the gaps of the lights

// distant lights in the form that the painter expects: far away, rotated about the vertical
function distantLights(face, { turn, power }) {
  const far = 100 * face.radius, angle = (turn * Math.PI) / 180, { direction, irradiance } = face.surroundings;
  return direction.map(([x, y, z], i) => {
    const towards = [Math.cos(angle) * x + Math.sin(angle) * z, y, Math.cos(angle) * z - Math.sin(angle) * x];
    return { towards, irradiance: irradiance[i], position: add(face.centre, towards, far), intensity: irradiance[i].map((e) => e * far * far), power };
  });
}

// real spherical harmonics of the orders 0 to 3, as in skindb/view/transfer.py
function harmonics([x, y, z]) {
  const r = Math.sqrt;
  return [
    0.5, r(3 / 4) * x, r(3 / 4) * y, r(3 / 4) * z, r(15 / 4) * x * y, r(15 / 4) * y * z, r(15 / 4) * x * z,
    r(5 / 16) * (3 * z * z - 1), r(15 / 16) * (x * x - y * y), r(35 / 32) * y * (3 * x * x - y * y), r(105 / 4) * x * y * z,
    r(21 / 32) * y * (5 * z * z - 1), r(7 / 16) * z * (5 * z * z - 3), r(21 / 32) * x * (5 * z * z - 1),
    r(105 / 16) * z * (x * x - y * y), r(35 / 32) * x * (x * x - 3 * y * y),
  ].map((value) => value / r(Math.PI));
}

// coefficients of the radiance of the lights (16 x 3), of which a product with the transfer of a surfel is the irradiance
// under the boundary
function skyHarmonics(lights) {
  const sky = new Float32Array(48);
  for (const { towards, irradiance, power } of lights)
    harmonics(towards).forEach((value, k) => irradiance.forEach((e, c) => { sky[3 * k + c] += value * e * power; }));
  return sky;
}

// radiance of the lights as a smooth image of all directions (height x width x 4)
function mirrorImage(lights) {
  const { width, height, sharpness } = MIRROR, out = new Float32Array(4 * width * height);
  for (let i = 0; i < width * height; i++) {
    const polar = (Math.PI * (Math.floor(i / width) + 0.5)) / height, turn = 2 * Math.PI * (((i % width) + 0.5) / width - 0.5);
    const way = [Math.sin(polar) * Math.sin(turn), Math.cos(polar), Math.sin(polar) * Math.cos(turn)];
    for (const { towards, irradiance, power } of lights) {
      const lobe = (power * sharpness * Math.exp(sharpness * (dot(way, towards) - 1))) / (2 * Math.PI);
      for (let c = 0; c < 3; c++) out[4 * i + c] += lobe * irradiance[c];
    }
  }
  return out;
}
