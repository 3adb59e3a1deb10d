// Shaders of the scan and of the points on it; gpu.js compiles SHADERS.
"use strict";

const SHADERS = {
  scan: {
    vertex: `#version 300 es
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec3 colour;
uniform mat4 matrix;
out vec3 place, direction, own;
void main() {
  place = position; direction = normal; own = colour;
  gl_Position = matrix * vec4(position, 1.0);
}`,
    fragment: `#version 300 es
precision highp float;
in vec3 place, direction, own;
uniform vec3 eye, up, low, high;
uniform int coloured;
out vec4 pixel;
void main() {
  vec3 view = normalize(eye - place), flat_ = normalize(cross(dFdx(place), dFdy(place)));
  vec3 n = dot(direction, direction) > 0.0 ? normalize(direction) : flat_;
  float side = abs(dot(n, normalize(view + 0.6 * up)));  // triangles of scans may have either orientation
  vec3 base = coloured == 1 ? own : vec3(0.78, 0.72, 0.68);
  vec3 shade = base * (coloured == 1 ? 0.55 + 0.45 * side : 0.15 + 0.85 * side * side);
  bool kept = all(greaterThanEqual(place, low)) && all(lessThanEqual(place, high));
  pixel = vec4(kept ? shade : mix(shade, vec3(0.3, 0.05, 0.05), 0.75), 1.0);
}`,
  },
  mark: {
    vertex: `#version 300 es
layout(location = 0) in vec3 position;
uniform mat4 matrix;
uniform vec3 eye;
uniform float size, lift;
void main() {
  gl_Position = matrix * vec4(position + lift * normalize(eye - position), 1.0);
  gl_PointSize = size;
}`,
    fragment: `#version 300 es
precision highp float;
uniform vec3 colour;
out vec4 pixel;
void main() {
  float r = length(2.0 * gl_PointCoord - 1.0);
  if (r > 1.0) discard;
  pixel = vec4(r > 0.7 ? vec3(0.05) : colour, 1.0);
}`,
  },
};
