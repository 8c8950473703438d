// One pass projects every splat into a texture, one draws them. The arithmetic is that of functional/projection.py.
"use strict";
const Shaders = (() => {
  const PREPARE_VERTEX = `#version 300 es
void main() { gl_Position = vec4(vec2((gl_VertexID << 1) & 2, gl_VertexID & 2) * 2.0 - 1.0, 0.0, 1.0); }`;

  const PREPARE = (degree) => `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2DArray;
const int DEGREE = ${degree};
const int WIDTH = 1024;
uniform highp sampler2D means;       // xyz, opacity
uniform highp sampler2D scales;      // xyz, level; 0 has not arrived
uniform highp sampler2D quats;       // wxyz
uniform highp sampler2D decays;      // sigma
uniform sampler2DArray harmonics;    // coefficients, three after three, four to a layer
uniform mat4 view;
uniform vec3 eye;
uniform vec4 intrinsics;             // fx fy cx cy
uniform vec2 size;                   // px
uniform float level;
uniform float enlarge;               // of all axes, while part of the base is missing
uniform float distance_scale;        // s_v
uniform float scene_distance;        // 0: no decay
uniform float antialiased, signed_residuals;
layout(location = 0) out uvec4 place;   // centre px, axis 1 px
layout(location = 1) out uvec4 extent;  // axis 2 px, opacity, reach
layout(location = 2) out uvec4 colour;

float coefficient(int i, ivec2 at) { return texelFetch(harmonics, ivec3(at, i >> 2), 0)[i & 3]; }
vec3 sh(int k, ivec2 at) { return vec3(coefficient(3 * k, at), coefficient(3 * k + 1, at), coefficient(3 * k + 2, at)); }

vec3 evaluate(vec3 d, ivec2 at) {
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  vec3 c = 0.28209479177387814 * sh(0, at);
  if (DEGREE > 0) c += 0.4886025119029199 * (-y * sh(1, at) + z * sh(2, at) - x * sh(3, at));
  if (DEGREE > 1) {
    c += 1.0925484305920792 * (x * y * sh(4, at) - y * z * sh(5, at) - x * z * sh(7, at));
    c += 0.31539156525252005 * (2.0 * zz - xx - yy) * sh(6, at) + 0.5462742152960396 * (xx - yy) * sh(8, at);
  }
  if (DEGREE > 2) {
    c += -0.5900435899266435 * (y * (3.0 * xx - yy) * sh(9, at) + x * (xx - 3.0 * yy) * sh(15, at));
    c += 2.890611442640554 * x * y * z * sh(10, at) + 1.445305721320277 * z * (xx - yy) * sh(14, at);
    c += -0.4570457994644658 * (4.0 * zz - xx - yy) * (y * sh(11, at) + x * sh(13, at));
    c += 0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * sh(12, at);
  }
  if (DEGREE > 3) {
    c += 2.5033429417967046 * x * y * (xx - yy) * sh(16, at) - 1.7701307697799304 * y * z * (3.0 * xx - yy) * sh(17, at);
    c += 0.9461746957575601 * x * y * (7.0 * zz - 1.0) * sh(18, at);
    c += -0.6690465435572892 * (7.0 * zz - 3.0) * z * (y * sh(19, at) + x * sh(21, at));
    c += 0.10578554691520431 * (zz * (35.0 * zz - 30.0) + 3.0) * sh(20, at);
    c += 0.47308734787878004 * (xx - yy) * (7.0 * zz - 1.0) * sh(22, at);
    c += -1.7701307697799304 * x * z * (xx - 3.0 * yy) * sh(23, at);
    c += 0.6258357354491761 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy)) * sh(24, at);
  }
  return c;
}

// Weight of functional/attenuation.py: a prefix of levels times the decay with distance and its soft cut.
float weight(float own, float opacity, float sigma, float range) {
  float w = own <= floor(level) ? 1.0 : own <= floor(level) + 1.0 ? level - floor(level) : 0.0;
  if (own < 0.5 || w <= 0.0) return 0.0;
  if (scene_distance > 0.0) {
    sigma = max(sigma, 0.0);
    float far = min(range / scene_distance * distance_scale / sqrt(2.0 * sigma * sigma + 1e-8), 100.0);
    float exponent = -far * far;
    float margin = log(max(opacity, 1e-30)) + exponent - log(distance_scale / 255.0);
    if (margin <= 0.0) return 0.0;
    float fade = min(exp(min(margin, 0.6931471805599453)) - 1.0, 1.0);
    w *= exp(max(exponent, -85.0)) * fade * fade * (3.0 - 2.0 * fade);
  }
  return w;
}

void main() {
  place = uvec4(0); extent = uvec4(0); colour = uvec4(0);
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec4 m = texelFetch(means, at, 0), s = texelFetch(scales, at, 0), q = texelFetch(quats, at, 0);
  vec3 offset = m.xyz - eye;
  float range = length(offset);
  float opacity = m.w * weight(s.w, m.w, texelFetch(decays, at, 0).x, range);
  mat3 R = mat3(view);
  vec3 p = R * offset;
  if (opacity <= 0.0 || p.z <= 0.01) return;

  q /= max(length(q), 1e-20);
  float w = q.x, x = q.y, y = q.z, z = q.w;
  vec3 stretch = min(enlarge * s.xyz, vec3(1e8 * p.z / max(intrinsics.x, intrinsics.y)));
  mat3 M = mat3(
    stretch.x * vec3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
    stretch.y * vec3(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
    stretch.z * vec3(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)));
  mat3 V = R * M;
  vec2 f = intrinsics.xy, c = intrinsics.zw, tangent = p.xy / p.z, margin = 0.15 * size / f;
  vec2 held = clamp(tangent, -c / f - margin, (size - c) / f + margin), slope = f / p.z;
  vec3 rowX = vec3(V[0].x, V[1].x, V[2].x), rowY = vec3(V[0].y, V[1].y, V[2].y), rowZ = vec3(V[0].z, V[1].z, V[2].z);
  vec3 bx = slope.x * (rowX - held.x * rowZ), by = slope.y * (rowY - held.y * rowZ);
  float a = dot(bx, bx) + 0.3, b = dot(bx, by), d = dot(by, by) + 0.3;
  vec3 n = cross(bx, by);
  float sharp = dot(n, n), det = sharp + 0.3 * (a + d - 0.3);
  if (antialiased > 0.5) opacity *= sqrt(sharp / det);
  opacity = min(opacity, 1.0);
  // alpha reaches 1/255 this many variances squared from the centre
  float reach = 2.0 * log(255.0 * opacity);
  if (!(reach > 0.0) || !(det > 0.0)) return;
  float half_trace = 0.5 * (a + d), root = length(vec2(0.5 * (a - d), b));
  float major = half_trace + root, minor = det / major;
  vec2 direction = abs(b) > 1e-12 * major ? normalize(a >= d ? vec2(0.5 * (a - d) + root, b) : vec2(b, 0.5 * (d - a) + root)) : a >= d ? vec2(1, 0) : vec2(0, 1);
  vec2 centre = tangent * f + c;
  float radius = ceil(3.0 * sqrt(half_trace + sqrt(max(half_trace * half_trace - det, 0.01))));
  if (any(lessThanEqual(centre + radius, vec2(0.0))) || any(greaterThanEqual(centre - radius, size))) return;

  vec3 rgb = max(evaluate(range > 0.0 ? offset / range : vec3(0.0), at) + 0.5, 0.0);
  if (signed_residuals > 0.5 && s.w > 1.5) rgb = 2.0 * rgb - 1.0;
  place = floatBitsToUint(vec4(centre, direction * sqrt(major)));
  extent = floatBitsToUint(vec4(vec2(-direction.y, direction.x) * sqrt(minor), opacity, reach));
  colour = floatBitsToUint(vec4(rgb, 1.0));
}`;

  const SPLAT_VERTEX = `#version 300 es
precision highp float;
precision highp int;
precision highp usampler2D;
uniform usampler2D place, extent, colour;
uniform vec2 size;
layout(location = 0) in uint row;
out vec2 offset;
flat out vec4 shade;
void main() {
  ivec2 at = ivec2(int(row) & 1023, int(row) >> 10);
  vec4 p = uintBitsToFloat(texelFetch(place, at, 0)), e = uintBitsToFloat(texelFetch(extent, at, 0));
  shade = vec4(uintBitsToFloat(texelFetch(colour, at, 0)).rgb, e.z);
  offset = vec2((gl_VertexID & 1) * 2 - 1, (gl_VertexID >> 1) * 2 - 1) * sqrt(e.w);
  vec2 px = p.xy + offset.x * p.zw + offset.y * e.xy;
  gl_Position = e.z > 0.0 ? vec4(px / size * 2.0 - 1.0, 0.0, 1.0) : vec4(2.0, 2.0, 2.0, 1.0);
}`;

  // Front to back: what is behind counts as much as is let through. Colours may be negative.
  const SPLAT = `#version 300 es
precision highp float;
in vec2 offset;
flat in vec4 shade;
out vec4 result;
void main() {
  float alpha = min(shade.a * exp(-0.5 * dot(offset, offset)), 0.999);
  if (alpha < 1.0 / 255.0) discard;
  result = vec4(shade.rgb * alpha, alpha);
}`;

  const SHOW = `#version 300 es
precision highp float;
uniform highp sampler2D picture;
uniform vec3 background;
out vec4 result;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy), whole = textureSize(picture, 0);
  vec4 sum = texelFetch(picture, ivec2(at.x, whole.y - 1 - at.y), 0);
  result = vec4(clamp(sum.rgb + (1.0 - sum.a) * background, 0.0, 1.0), 1.0);
}`;

  return { PREPARE_VERTEX, PREPARE, SPLAT_VERTEX, SPLAT, SHOW };
})();
