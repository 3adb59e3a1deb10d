// GLSL of the viewer. Radiance of a surface under point lights (Weyrich et al. 2005, eq. 1 to 4 and 8):
//   L = sum over lights of I cos(theta_i) / d^2 (F_t(i) F_t(o) R_d / pi + sum over k of w_k b_k)
"use strict";

const MAX_LIGHTS = 4;

const COMMON = `#version 300 es
precision highp float;
precision highp sampler3D;
precision highp sampler2DArrayShadow;
const float PI = 3.14159265358979;
const int MAX_LIGHTS = ${MAX_LIGHTS};
uniform int lightCount;
uniform vec3 lightPosition[MAX_LIGHTS];   // mm
uniform vec3 lightIntensity[MAX_LIGHTS];  // radiance mm2
uniform mat4 lightMatrix[MAX_LIGHTS];
uniform sampler2DArrayShadow shadowMap;
uniform float eta;
uniform float shadowRadius;  // texels of the shadow map
uniform bool singleTap;

float transmittance(float c) {
  float g = sqrt(eta * eta - 1.0 + c * c);
  float a = (g - c) / (g + c);
  float b = (c * (g + c) - 1.0) / (c * (g - c) + 1.0);
  return 1.0 - 0.5 * a * a * (1.0 + b * b);
}

// four comparisons, each filtered over four texels by the hardware; only one without a graphics card
float lit(int i, vec3 position, vec3 normal) {
  vec4 at = lightMatrix[i] * vec4(position + normal * 0.6, 1.0);
  vec3 place = at.xyz / at.w * 0.5 + 0.5;
  float texel = shadowRadius / float(textureSize(shadowMap, 0).x);
  if (singleTap) return texture(shadowMap, vec4(place.xy, float(i), place.z - 0.0015));
  float sum = 0.0;
  for (int y = 0; y < 2; y++)
    for (int x = 0; x < 2; x++)
      sum += texture(shadowMap, vec4(place.xy + (vec2(x, y) * 1.6 - 0.8) * texel, float(i), place.z - 0.0015));
  return sum / 4.0;
}
`;

// irradiance under the boundary by the environment, and the openness of the surface, from 0 to 1 without anything in the way
const AMBIENT = `
layout(location = 9) in mat4 transfer;
uniform mat4x3 sky[4];
uniform float open;  // largest first coefficient
vec4 ambient() {
  vec3 sum = sky[0] * transfer[0] + sky[1] * transfer[1] + sky[2] * transfer[2] + sky[3] * transfer[3];
  return vec4(max(sum, 0.0), transfer[0][0] / open);
}
`;

// irradiance under the boundary by lights and environment, computed at texels or, with AT_VERTICES, at vertices
const IRRADIANCE = `
vec3 irradiance(vec3 position, vec3 n, vec3 sum) {
  for (int i = 0; i < lightCount; i++) {
    vec3 way = lightPosition[i] - position;
    float square = dot(way, way), c = dot(way, n) * inversesqrt(square);
    if (c > 0.0) sum += lightIntensity[i] * (c / square * transmittance(c) * lit(i, position, n));
  }
  return sum;
}
`;

// values of a surfel for RADIANCE, as variables or as outputs
const surfel = (kind) => `
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec3 albedo;
layout(location = 3) in vec4 weightA;
layout(location = 4) in vec4 weightB;
layout(location = 6) in vec2 uv;
${kind} vec3 vPosition; ${kind} vec3 vNormal; ${kind} vec3 vAlbedo; ${kind} vec4 vWeightA; ${kind} vec2 vUv; ${kind} vec4 vAmbient;
#ifdef SECOND_TABLE
${kind} vec4 vWeightB;
#endif
${AMBIENT}
void setSurfel() {
  vPosition = position; vNormal = normal; vAlbedo = albedo; vWeightA = weightA; vUv = uv; vAmbient = ambient();
#ifdef SECOND_TABLE
  vWeightB = weightB;
#endif
}
`;

// changes of albedo (below in the texture) and normal (above) that are finer than the surfels
const DETAIL = `
uniform bool withDetail;
uniform sampler2D detail;
in vec2 vUv;
vec3 finer(float side) {
  return withDetail ? (texture(detail, vec2(vUv.x, 0.5 * (vUv.y + side))).rgb * 255.0 - 128.0) / 127.0 : vec3(0.0);
}
vec3 finerAlbedo(vec3 albedo) { return albedo * (1.0 + finer(0.0)); }
vec3 finerNormal(vec3 normal) { return normalize(normal + finer(1.0)); }
`;

// radiance at pixels or, with AT_VERTICES, at vertices
const RADIANCE = `
uniform sampler3D tableA;
uniform sampler3D tableB;
uniform sampler2D glow;
uniform vec3 eye;
uniform bool withDiffuse, withSurface, withGlow;
uniform bool withMirror;  // whether the surface reflects a smooth image of the environment
uniform sampler2D mirror;
uniform sampler2D lobes;  // directional albedo of the bases
const float MIN_COSINE = 0.03;

// half and difference angles (Rusinkiewicz 1998) as coordinates of the tables
vec3 place(vec3 n, vec3 wi, vec3 wo) {
  vec3 h = normalize(wi + wo);
  vec3 b = cross(n, h), t = cross(b, h);
  float sinH = length(b), sinD = length(cross(h, wi));
  float thetaH = atan(sinH, max(dot(n, h), 0.0)), thetaD = atan(sinD, max(dot(h, wi), 0.0));
  float phi = sinH > 1e-6 ? atan(dot(b, wi), dot(t, wi)) : 0.0;
  if (phi < 0.0) phi += PI;
  vec3 size = vec3(textureSize(tableA, 0));
  vec2 at = vec2(thetaD, thetaH) / (0.5 * PI);
  at.y = sqrt(at.y);
  return vec3((clamp(at, 0.0, 1.0) * (size.xy - 1.0) + 0.5) / size.xy, phi / PI + 0.5 / size.z);
}

// adds the reflection of one light
void reflected(int i, vec3 n, vec3 wo, float leaves, inout vec3 matte, inout vec3 gloss) {
  vec3 way = lightPosition[i] - vPosition;
  float square = dot(way, way);
  vec3 wi = way * inversesqrt(square);
  float cosI = dot(wi, n);
  if (cosI <= 0.0) return;
  float visible = lit(i, vPosition, n);
  if (visible == 0.0) return;
  vec3 received = lightIntensity[i] * (cosI / square * visible);
  if (!withGlow) matte += received * (transmittance(min(cosI, 1.0)) * leaves / PI);
  if (!withSurface) return;
  vec3 at = place(n, wi, wo);
  float sum = dot(vWeightA, texture(tableA, at));
#ifdef SECOND_TABLE
  sum += dot(vWeightB, texture(tableB, at));
#endif
  gloss += received * sum;
}
vec3 radiance(vec3 n, vec3 albedo) {
  vec3 wo = normalize(eye - vPosition), matte = vec3(0.0), gloss = vec3(0.0);
  float cosO = dot(n, wo);
  if (cosO < MIN_COSINE) n = normalize(n + (MIN_COSINE - cosO) * wo);  // no black line where shading normals turn away
  cosO = clamp(cosO, MIN_COSINE, 1.0);
  float leaves = transmittance(cosO);
  // not a loop, which takes more time without a graphics card
  ${[...Array(MAX_LIGHTS).keys()].map((i) => `if (${i} < lightCount) reflected(${i}, n, wo, leaves, matte, gloss);`).join("\n  ")}
  vec4 under = withGlow ? texture(glow, vUv) : vec4(vAmbient.rgb, 1.0);
#ifdef AT_VERTICES
  under /= max(under.a, 0.01);  // texels without a vertex are empty
#endif
  matte += under.rgb * (leaves / PI);
  if (withSurface && withMirror) {
    vec3 way = reflect(-wo, n);
    float reflectance = dot(vWeightA, texture(lobes, vec2(cosO, 0.25)));
#ifdef SECOND_TABLE
    reflectance += dot(vWeightB, texture(lobes, vec2(cosO, 0.75)));
#endif
    gloss += texture(mirror, vec2(atan(way.x, way.z) / (2.0 * PI) + 0.5, acos(clamp(way.y, -1.0, 1.0)) / PI)).rgb * (reflectance * vAmbient.a);
  }
  return (withDiffuse ? matte * albedo : vec3(0.0)) + gloss;
}
`;

const ENCODE = `
uniform bool toned;
vec3 encode(vec3 x) {
  x = clamp(x, 0.0, 1.0);
  return mix(12.92 * x, 1.055 * pow(x, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, x));
}
// compresses values above 0.8 (Khronos PBR Neutral, whose shift for a reflectance of 4 % is left out)
vec3 shown(vec3 x) {
  float start = 0.8, range = 1.0 - start, peak = max(x.r, max(x.g, x.b));
  if (!toned || peak < start) return encode(x);
  float compressed = 1.0 - range * range / (peak + range - start);
  return encode(mix(vec3(compressed), x * (compressed / peak), 1.0 / (0.15 * (peak - compressed) + 1.0)));
}`;

// a triangle that covers the picture
const CORNERS = `#version 300 es
const vec2 CORNER[3] = vec2[3](vec2(-1.0, -1.0), vec2(3.0, -1.0), vec2(-1.0, 3.0));
void main() { gl_Position = vec4(CORNER[gl_VertexID], 0.0, 1.0); }`;

const SHADERS = {
  depth: {
    vertex: `#version 300 es
layout(location = 0) in vec3 position;
uniform mat4 matrix;
void main() { gl_Position = matrix * vec4(position, 1.0); }`,
    fragment: `#version 300 es
precision highp float;
void main() {}`,
  },

  // irradiance under the boundary in texture space
  irradiance: {
    vertex: COMMON + `
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 6) in vec2 uv;
${AMBIENT}
#ifdef AT_VERTICES
flat out vec3 vIrradiance;
${IRRADIANCE}
#else
out vec3 vPosition; out vec3 vNormal; out vec3 vAmbient;
#endif
void main() {
#ifdef AT_VERTICES
  vIrradiance = irradiance(position, normal, ambient().rgb);
#else
  vPosition = position; vNormal = normal; vAmbient = ambient().rgb;
#endif
  gl_PointSize = 1.0;
  gl_Position = vec4(uv * 2.0 - 1.0, 0.0, 1.0);
}`,
    fragment: COMMON + `
out vec4 result;
#ifdef AT_VERTICES
flat in vec3 vIrradiance;
void main() { result = vec4(vIrradiance, 1.0); }
#else
in vec3 vPosition; in vec3 vNormal; in vec3 vAmbient;
${IRRADIANCE}
void main() { result = vec4(irradiance(vPosition, normalize(vNormal), vAmbient), 1.0); }
#endif
`,
  },

  // standard deviation [texels] of the blur in texture space
  radius: {
    vertex: `#version 300 es
layout(location = 5) in vec3 diffusion;
layout(location = 6) in vec2 uv;
layout(location = 7) in float spacing;
uniform vec3 width;
out vec3 vRadius;
void main() {
  vRadius = width * diffusion / spacing;
  gl_PointSize = 1.0;
  gl_Position = vec4(uv * 2.0 - 1.0, 0.0, 1.0);
}`,
    fragment: `#version 300 es
precision highp float;
in vec3 vRadius;
out vec4 result;
void main() { result = vec4(vRadius, 1.0); }`,
  },

  blur: {
    vertex: CORNERS,
    fragment: `#version 300 es
precision highp float;
uniform sampler2D source;
uniform sampler2D radius;
uniform vec2 along;
out vec4 result;
void main() {
  vec2 size = vec2(textureSize(source, 0)), at = gl_FragCoord.xy / size;
  vec4 middle = texelFetch(source, ivec2(gl_FragCoord.xy), 0);
  result = vec4(0.0);
  if (middle.a == 0.0) return;
  vec3 sigma = max(texelFetch(radius, ivec2(gl_FragCoord.xy), 0).rgb, 0.02), sum = vec3(0.0), weight = vec3(1e-6);
  float widest = max(sigma.r, max(sigma.g, sigma.b));
  vec3 sharpness = 0.5 * widest * widest / (sigma * sigma);
  for (int k = -6; k <= 6; k++) {  // the channels share the taps, which suffice for widths in a ratio of up to 5
    float x = float(k) * 0.45;
    vec4 tap = texture(source, at + along * (x * widest) / size);
    vec3 g = exp(-sharpness * x * x);
    sum += g * tap.rgb;
    weight += g * tap.a;
  }
  result = vec4(sum / weight * middle.a, middle.a);
}`,
  },

  // normals, translucency, status, error and albedo as colours
  components: {
    vertex: `#version 300 es
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec3 albedo;
layout(location = 5) in vec3 diffusion;
layout(location = 6) in vec2 uv;
layout(location = 8) in vec2 quality;
uniform mat4 matrix;
uniform highp int component;
out vec3 vShown; out vec2 vUv;
void main() {
  vUv = uv;
  vShown = component == 1 ? normal : component == 2 ? diffusion / 3.0 : component == 5 ? albedo : vec3(quality, 0.0);
  gl_Position = matrix * vec4(position, 1.0);
}`,
    fragment: `#version 300 es
precision highp float;
uniform highp int component;  // 1 normals, 2 translucency, 3 status, 4 error of the albedo, 5 albedo
in vec3 vShown;
out vec4 result;
${DETAIL}
${ENCODE}
vec3 scale(float x) {  // dark blue to yellow, monotone in lightness
  x = clamp(x, 0.0, 1.0);
  return clamp(vec3(1.6 * x * x - 0.1 * x + 0.25 * (1.0 - x), 0.05 + 0.85 * x, 0.35 + 0.6 * x - 1.0 * x * x), 0.0, 1.0);
}
void main() {
  vec3 doubtful = vShown.x > 0.25 ? vec3(0.9, 0.7, 0.2) : vec3(0.75, 0.25, 0.2);
  if (component == 1) result = vec4(0.5 * finerNormal(vShown) + 0.5, 1.0);
  else if (component == 3) result = vec4(vShown.x > 0.75 ? vec3(0.2, 0.6, 0.3) : doubtful, 1.0);
  else if (component == 4) result = vec4(scale(vShown.y / 0.3), 1.0);
  else result = vec4(encode(component == 5 ? finerAlbedo(vShown) : vShown), 1.0);
}`,
  },

  face: {
    vertex: `#version 300 es
${surfel("out")}
uniform mat4 matrix;
void main() {
  setSurfel();
  gl_Position = matrix * vec4(position, 1.0);
}`,
    fragment: COMMON + `
uniform float exposure;
uniform bool linear;  // whether to output radiance, to be summed, instead of a display colour
in vec3 vPosition; in vec3 vNormal; in vec3 vAlbedo; in vec4 vWeightA; in vec4 vAmbient;
#ifdef SECOND_TABLE
in vec4 vWeightB;
#endif
out vec4 result;
${DETAIL}
${ENCODE}
${RADIANCE}
void main() {
  vec3 sum = exposure * radiance(finerNormal(vNormal), finerAlbedo(vAlbedo));
  result = vec4(linear ? sum : shown(sum), 1.0);
}`,
  },

  // radiance of the vertices that the view shows, each at a texel of its own
  light: {
    vertex: COMMON + `
#define AT_VERTICES
${surfel("")}
${RADIANCE}
uniform ivec2 size;
flat out vec3 vRadiance;
void main() {
  setSurfel();
  gl_PointSize = 1.0;
  gl_Position = vec4((vec2(gl_VertexID % size.x, gl_VertexID / size.x) + 0.5) / vec2(size) * 2.0 - 1.0, 0.0, 1.0);
  vRadiance = radiance(normal, albedo);
}`,
    fragment: `#version 300 es
precision highp float;
flat in vec3 vRadiance;
out vec4 result;
void main() { result = vec4(vRadiance, 1.0); }`,
  },

  // the face between vertices whose radiance is known
  coarse: {
    vertex: `#version 300 es
layout(location = 0) in vec3 position;
layout(location = 6) in vec2 uv;
uniform mat4 matrix;
uniform highp sampler2D source;
out vec3 vRadiance; out vec2 vUv;
void main() {
  int width = textureSize(source, 0).x;
  vRadiance = texelFetch(source, ivec2(gl_VertexID % width, gl_VertexID / width), 0).rgb;
  vUv = uv;
  gl_Position = matrix * vec4(position, 1.0);
}`,
    fragment: `#version 300 es
precision highp float;
uniform float exposure;
in vec3 vRadiance;
out vec4 result;
${DETAIL}
${ENCODE}
void main() { result = vec4(shown(exposure * finerAlbedo(vRadiance)), 1.0); }`,
  },

  // sum of the passes as display colours
  shown: {
    vertex: CORNERS,
    fragment: `#version 300 es
precision highp float;
uniform sampler2D source;
uniform vec4 background;
out vec4 result;
${ENCODE}
void main() {
  vec4 sum = texelFetch(source, ivec2(gl_FragCoord.xy), 0);
  result = sum.a > 0.0 ? vec4(shown(sum.rgb), 1.0) : background;
}`,
  },
};
