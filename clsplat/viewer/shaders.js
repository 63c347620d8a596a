// GLSL versions of cl_kernels/gaussian.h, project.cl, harmonics.h and splat.h.

const HEAD = `#version 300 es
precision highp float; precision highp int; precision highp sampler2D; precision highp usampler2D;
#define SHELL 1.2             // radius of an ellipsoid in standard deviations
uniform sampler2D tables;  // [4, 256]: scale, opacity, color of band 0, color of the other bands
uniform usampler2D places; // position and quaternion of a splat
float entry(int table, uint code) { return texelFetch(tables, ivec2(int(code), table), 0).x; }
ivec2 spot(int i) { return ivec2(i & 4095, i >> 12); }`;

// Mean, opacity factor and quaternion of a splat at the current timestamp: of static models, unchanged.
const STATIC_MODEL = `
vec4 moved(int i, vec3 mean) { return vec4(mean, 1); }  // mean, opacity factor
vec4 turned(int i, vec4 q) { return q; }`;

// Moving models have rows of velocity, center time, log duration, optional coefficients of dt^2 and dt^3, and an
// optional change of the quaternion (x, y, z, w), as in cl_kernels/motion.cl.
const MOVING_MODEL = `
uniform sampler2D motions;
uniform int wide, bends, turns;  // texels of a row; number of coefficients; column of the turn, or 0
uniform float timestamp;
float column(int i, int k) {
  int row = 4096 / wide;
  return texelFetch(motions, ivec2((i % row) * wide + k / 4, i / row), 0)[k % 4];
}
vec3 three(int i, int k) { return vec3(column(i, k), column(i, k + 1), column(i, k + 2)); }
vec4 moved(int i, vec3 mean) {
  float dt = timestamp - column(i, 3), late = dt * exp(-column(i, 4));
  vec3 way = three(i, 0);
  if (bends > 0) way += three(i, 5) * dt;
  if (bends > 1) way += three(i, 8) * dt * dt;
  return vec4(mean + way * dt, exp(-.5 * late * late));
}
vec4 turned(int i, vec4 q) {
  if (turns == 0) return q;
  return normalize(q + vec4(three(i, turns), column(i, turns + 3)) * (timestamp - column(i, 3)));
}`;

// A triangle that covers the target.
const COVER = `#version 300 es
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3 : -1, gl_VertexID == 2 ? 3 : -1, 0, 1); }`;

// Colors of all splats for one camera position: max(0, 1/2 + sum_k basis_k(d) sh_k), one texel each.
const colors = motion => HEAD + motion + `
uniform usampler2D codes;
uniform vec3 eye;
uniform int degree, texels, count;
out vec4 color;
uint code(uvec4 a[3], int b) { return (a[b >> 4][(b >> 2) & 3] >> uint(8 * (b & 3))) & 255u; }
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  int i = at.y * 4096 + at.x, row = 4096 / texels;
  if (i >= count) discard;
  uvec4 a[3];
  for (int k = 0; k < 3; k++) a[k] = texelFetch(codes, ivec2((i % row) * texels + min(k, texels - 1), i / row), 0);
  vec3 d = normalize(moved(i, uintBitsToFloat(texelFetch(places, at, 0).xyz)).xyz - eye);
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  float basis[16] = float[16](.28209479,
    -.48860251 * y, .48860251 * z, -.48860251 * x,
    1.0925484 * x * y, -1.0925484 * y * z, .31539157 * (2. * zz - xx - yy), -1.0925484 * x * z, .54627422 * (xx - yy),
    -.59004359 * y * (3. * xx - yy), 2.8906114 * x * y * z, -.45704580 * y * (4. * zz - xx - yy),
    .37317633 * z * (2. * zz - 3. * xx - 3. * yy), -.45704580 * x * (4. * zz - xx - yy),
    1.4453057 * z * (xx - yy), -.59004359 * x * (xx - 3. * yy));
  vec3 sum = vec3(.5);
  int number = (degree + 1) * (degree + 1);
  for (int k = 0; k < 16; k++) {
    if (k >= number) break;
    int table = k == 0 ? 2 : 3;
    sum += basis[k] * vec3(entry(table, code(a, 3 * k)), entry(table, code(a, 3 * k + 1)),
                           entry(table, code(a, 3 * k + 2)));
  }
  color = vec4(max(sum, 0.), 1);
}`;

const splatVertex = motion => HEAD + motion + `
uniform usampler2D sizes;
uniform sampler2D colors;
uniform mat3 rotation;       // world to camera
uniform vec3 translation;
uniform vec4 intrinsics;     // fx, fy, cx, cy of the target, px
uniform vec4 limits;         // of x/z and y/z in the linearized projection: min x, max x, min y, max y
uniform vec2 size;           // of the target, px
uniform vec3 filters;        // near plane, screen variance in px^2, compensate
uniform int mode;            // 0 splats, 1 points, 2 ellipsoids, 3 opacity
uniform float dot_radius;    // px
in uint id;
in vec2 corner;
out vec2 p;                  // in standard deviations, or in radii of a point
flat out vec4 shade;
vec3 ramp(float t) {         // from violet through green to yellow
  vec3 middle = vec3(.13, .57, .55);
  return t < .5 ? mix(vec3(.27, .05, .40), middle, 2. * t) : mix(middle, vec3(.99, .91, .15), 2. * t - 1.);
}
void main() {
  gl_Position = vec4(0, 0, 2, 1);
  int i = int(id);
  uvec4 place = texelFetch(places, spot(i), 0);
  uint shape = texelFetch(sizes, spot(i), 0).x;
  vec4 now = moved(i, uintBitsToFloat(place.xyz));
  vec3 m = rotation * now.xyz + translation;
  if (!(m.z >= filters.x)) return;
  vec3 scale = vec3(entry(0, shape & 255u), entry(0, (shape >> 8) & 255u), entry(0, (shape >> 16) & 255u));
  float opacity = entry(1, shape >> 24) * now.w;

  uint word = place.w;
  vec3 part = (vec3((word >> 20) & 1023u, (word >> 10) & 1023u, word & 1023u) / 1023. - .5) * 1.41421356;
  float rest = sqrt(max(0., 1. - dot(part, part)));
  uint largest = word >> 30;
  vec4 q = largest == 0u ? vec4(rest, part) : largest == 1u ? vec4(part.x, rest, part.yz)
         : largest == 2u ? vec4(part.xy, rest, part.z) : vec4(part, rest);
  q = turned(i, q);
  float x = q.x, y = q.y, z = q.z, w = q.w;
  mat3 turn = mat3(1. - 2. * (y * y + z * z), 2. * (x * y + w * z), 2. * (x * z - w * y),
                   2. * (x * y - w * z), 1. - 2. * (x * x + z * z), 2. * (y * z + w * x),
                   2. * (x * z + w * y), 2. * (y * z - w * x), 1. - 2. * (x * x + y * y));

  vec2 ray = clamp(m.xy / m.z, limits.xz, limits.yw);
  mat3 world = transpose(rotation);
  vec3 j0 = intrinsics.x / m.z * (world[0] - ray.x * world[2]), j1 = intrinsics.y / m.z * (world[1] - ray.y * world[2]);
  vec3 v0 = j0 * turn * scale, v1 = j1 * turn * scale;  // rows of J W R S; the covariance is V V^T
  float xx = dot(v0, v0), xy = dot(v0, v1), yy = dot(v1, v1), variance = filters.y;
  vec3 normal = cross(v0, v1);
  float before = dot(normal, normal), determinant = before + variance * (xx + yy + variance);
  if (!(determinant > 0.)) return;
  opacity *= sqrt(1. + filters.z * (before / determinant - 1.));
  if (!(opacity > 1. / 255.)) return;

  float a = xx + variance, c = yy + variance, half_gap = .5 * (a - c);
  float large = .5 * (a + c) + sqrt(half_gap * half_gap + xy * xy), angle = .5 * atan(2. * xy, a - c);
  vec2 along = vec2(cos(angle), sin(angle));
  float reach = mode == 2 ? SHELL : sqrt(2. * log(255. * opacity));
  vec2 across = vec2(-along.y, along.x), radii = sqrt(vec2(large, determinant / large));
  vec2 offset = reach * (corner.x * radii.x * along + corner.y * radii.y * across);
  p = corner * reach;
  if (mode == 1) { p = corner; offset = corner * dot_radius; }
  if (mode == 2 && (opacity < .2 || reach * radii.x > .3 * max(size.x, size.y))) return;  // would hide all other splats
  vec2 at = intrinsics.xy * m.xy / m.z + intrinsics.zw + offset;
  gl_Position = vec4(at.x / size.x * 2. - 1., 1. - at.y / size.y * 2., 0, 1);
  shade = vec4(mode == 3 ? ramp(opacity) : texelFetch(colors, spot(i), 0).rgb, opacity);
}`;

const SPLAT_FRAGMENT = `#version 300 es
precision highp float; precision highp int;
#define SHELL 1.2
uniform int mode;
in vec2 p;
flat in vec4 shade;
out vec4 pixel;
void main() {
  float square = dot(p, p);
  if (mode == 1) { if (square > 1.) discard; pixel = vec4(shade.rgb, 1); return; }
  if (mode == 2) {
    float depth = 1. - square / (SHELL * SHELL);
    if (depth < 0.) discard;
    pixel = vec4(shade.rgb * (.45 + .55 * sqrt(depth)), 1);
    return;
  }
  float alpha = min(.99, shade.a * exp(-.5 * square));
  if (alpha < 1. / 255.) discard;
  pixel = vec4(shade.rgb * alpha, alpha);
}`;

// The target over the background, on the canvas.
const PRESENT = `#version 300 es
precision highp float; precision highp sampler2D;
uniform sampler2D target;
uniform vec3 background;
uniform vec4 area;           // of the canvas: left, bottom, width, height, px
out vec4 pixel;
void main() {
  vec4 sum = texture(target, (gl_FragCoord.xy - area.xy) / area.zw);
  pixel = vec4(sum.rgb + background * (1. - sum.a), 1);
}`;
