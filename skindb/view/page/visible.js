// Triangles that a view can show, selected before drawing: without a graphics card, triangles cost as much as pixels.
"use strict";

class VisibleTriangles {
  constructor({ position, triangles, corners = Uint32Array.from(new Set(triangles)) }) {
    const count = triangles.length / 3;
    Object.assign(this, { position, triangles, corners, planes: new Float32Array(4 * count), chosen: new Uint32Array(triangles.length) });
    this.across = new Float32Array(position.length / 3);  // horizontal place in the picture, from -1 to 1
    const { planes } = this;
    for (let i = 0; i < count; i++) {
      const a = 3 * triangles[3 * i], b = 3 * triangles[3 * i + 1], c = 3 * triangles[3 * i + 2];
      const px = position[a], py = position[a + 1], pz = position[a + 2];
      const ux = position[b] - px, uy = position[b + 1] - py, uz = position[b + 2] - pz;
      const vx = position[c] - px, vy = position[c + 1] - py, vz = position[c + 2] - pz;
      const x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx, size = Math.hypot(x, y, z) || 1;
      planes[4 * i] = x / size;
      planes[4 * i + 1] = y / size;
      planes[4 * i + 2] = z / size;
      planes[4 * i + 3] = (x * px + y * py + z * pz) / size;
    }
  }

  // Indices of the triangles that face the eye and reach between two horizontal places, from -1 to 1. Triangles that
  // are seen from the side, within a degree, are kept: rounding of their corners to parts of a pixel may turn them to the eye.
  select(eye, matrix, from, to) {
    const { position, triangles, planes, chosen, across } = this;
    const [x, y, z] = eye, tolerance = 2e-2 * Math.hypot(x, y, z);
    for (const i of this.corners) {
      const k = 3 * i, a = position[k], b = position[k + 1], c = position[k + 2];
      const w = matrix[3] * a + matrix[7] * b + matrix[11] * c + matrix[15];
      across[i] = w > 0 ? (matrix[0] * a + matrix[4] * b + matrix[8] * c + matrix[12]) / w : NaN;  // NaN keeps triangles
    }
    let size = 0;
    for (let i = 0, k = 0; i < triangles.length; i += 3, k += 4) {
      if (planes[k] * x + planes[k + 1] * y + planes[k + 2] * z - planes[k + 3] < -tolerance) continue;
      const a = triangles[i], b = triangles[i + 1], c = triangles[i + 2];
      if (across[a] < from && across[b] < from && across[c] < from) continue;
      if (across[a] > to && across[b] > to && across[c] > to) continue;
      chosen[size++] = a;
      chosen[size++] = b;
      chosen[size++] = c;
    }
    return chosen.subarray(0, size);
  }
}

// Triangles between fewer vertices, about `length` mm apart: one for each cell of the texture, and those of the border.
function fewerTriangles({ triangles, uv, spacing }, length) {
  const count = spacing.length, cells = Math.ceil(Float32Array.from(spacing).sort()[count >> 1] / length);
  const sides = new Map(), cell = new Map(), chosen = new Int32Array(count).fill(-1), out = [];
  for (let i = 0; i < triangles.length; i++) {
    const a = triangles[i], b = triangles[i % 3 === 2 ? i - 2 : i + 1], side = Math.min(a, b) * count + Math.max(a, b);
    if (!sides.delete(side)) sides.set(side, [a, b]);
  }
  for (const [a, b] of sides.values()) {
    chosen[a] = a;
    chosen[b] = b;
  }
  for (let i = 0; i < count; i++) {
    const at = Math.floor(uv[2 * i] * cells) * (cells + 1) + Math.floor(uv[2 * i + 1] * cells);
    if (chosen[i] >= 0) continue;
    if (!cell.has(at)) cell.set(at, i);
    chosen[i] = cell.get(at);
  }
  for (let i = 0; i < triangles.length; i += 3) {
    const [a, b, c] = [chosen[triangles[i]], chosen[triangles[i + 1]], chosen[triangles[i + 2]]];
    if (a !== b && b !== c && c !== a) out.push(a, b, c);
  }
  return Uint32Array.from(out);
}
