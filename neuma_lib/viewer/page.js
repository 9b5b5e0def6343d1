"use strict";
// Draws what page.py wrote: Gaussians as depth-sorted splats, particles as balls, cameras with their images.
// Matrices are row-major; cameras have OpenCV axes (x right, y down, z forward); lengths are metres, y is up.

const meta = JSON.parse(document.getElementById("meta").textContent);
const byId = (id) => document.getElementById(id);
const canvas = byId("canvas");
const SH = [0.28209479177387814, 0.4886025119029199, 1.0925484305920792, 0.31539156525252005, 0.5462742152960396,
  0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277];
const NEAR = 0.02, FAR = 30;

function fail(text) {
  byId("message").textContent = text;
  document.body.dataset.state = "failed";
}

// ---- data ----------------------------------------------------------------------------------------------------------

async function inflated() {
  const text = atob(byId("data").textContent.trim());
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Whole numbers of all frames (frames, components, count): differences, low bytes first, zigzag.
function whole(data, entry) {
  const size = entry.components * entry.count, total = size * entry.frames, wide = entry.bits === 16;
  const out = wide ? new Uint16Array(total) : new Uint8Array(total), start = entry.start;
  for (let i = 0; i < total; i++) {
    const code = wide ? data[start + i] | (data[start + total + i] << 8) : data[start + i];
    out[i] = ((code >> 1) ^ -(code & 1)) + (i < size ? 0 : out[i - size]);
  }
  return out;
}

class Frames {
  constructor(data, entry) {
    this.entry = entry;
    this.values = whole(data, entry);
  }
  // Component c of frame t, written to out[c + k * stride].
  into(t, out, stride, offset) {
    const { components: C, count: M, low, high, bits } = this.entry, top = 2 ** bits - 1;
    for (let c = 0; c < C; c++) {
      const scale = (high[c] - low[c]) / top, from = (t * C + c) * M;
      for (let k = 0; k < M; k++) out[offset + c + k * stride] = low[c] + scale * this.values[from + k];
    }
    return out;
  }
  frame(t) {
    return this.into(t, new Float32Array(this.entry.components * this.entry.count), this.entry.components, 0);
  }
}

// ---- drawing -------------------------------------------------------------------------------------------------------

const CAMERA = `
uniform mat3 R; uniform vec3 t; uniform vec2 focal; uniform vec2 centre; uniform vec2 size;
vec4 clip(vec3 p) {
  vec2 pixel = focal * p.xy + centre * p.z;
  float depth = (${FAR + NEAR} * p.z - ${(2 * FAR * NEAR).toFixed(6)}) / ${FAR - NEAR};
  return vec4(2.0 * pixel.x / size.x - p.z, p.z - 2.0 * pixel.y / size.y, depth, p.z);
}`;
const SOURCES = {
  splats: [`#version 300 es
precision highp float;
in vec2 corner; in vec3 mean; in vec3 covA; in vec3 covB; in vec4 colour;
out vec2 at; out vec4 tint;
${CAMERA}
void main() {
  vec3 p = R * mean + t;
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  if (p.z < ${NEAR}) return;
  mat3 V = mat3(covA.x, covA.y, covA.z, covA.y, covB.x, covB.y, covA.z, covB.y, covB.z);
  mat3 W = R * V * transpose(R);
  vec3 jx = vec3(focal.x / p.z, 0.0, -focal.x * p.x / (p.z * p.z));
  vec3 jy = vec3(0.0, focal.y / p.z, -focal.y * p.y / (p.z * p.z));
  float a = dot(jx, W * jx) + 0.1, b = dot(jx, W * jy), c = dot(jy, W * jy) + 0.1;
  float mid = 0.5 * (a + c), half_gap = length(vec2(0.5 * (a - c), b));
  vec2 axis = abs(b) > 1e-6 * mid ? normalize(vec2(b, mid + half_gap - a)) : (a >= c ? vec2(1, 0) : vec2(0, 1));
  float first = min(3.0 * sqrt(mid + half_gap), 2048.0), second = 3.0 * sqrt(max(mid - half_gap, 0.05));
  vec2 offset = corner.x * first * axis + corner.y * second * vec2(-axis.y, axis.x);
  gl_Position = clip(p);
  gl_Position.xy += 2.0 * offset * vec2(1, -1) / size * gl_Position.w;
  at = corner; tint = colour;
}`, `#version 300 es
precision highp float;
in vec2 at; in vec4 tint; out vec4 result;
void main() {
  float alpha = tint.a * exp(-4.5 * dot(at, at));
  if (dot(at, at) > 1.0 || alpha < 0.00392) discard;
  result = vec4(tint.rgb * alpha, alpha);
}`],
  balls: [`#version 300 es
precision highp float;
in vec2 corner; in vec3 mean; in vec4 colour; uniform float radius;
out vec2 at; out vec4 tint;
${CAMERA}
void main() {
  vec3 p = R * mean + t;
  at = corner; tint = colour;
  gl_Position = p.z < ${NEAR} ? vec4(2.0, 2.0, 2.0, 1.0) : clip(p + vec3(corner * radius, 0.0));
}`, `#version 300 es
precision highp float;
in vec2 at; in vec4 tint; out vec4 result;
void main() {
  float r = dot(at, at);
  if (r > 1.0) discard;
  float light = 0.62 + 0.38 * dot(vec3(at, -sqrt(1.0 - r)), normalize(vec3(0.3, -0.8, -0.6)));
  result = vec4(tint.rgb * light, 1.0);
}`],
  lines: [`#version 300 es
precision highp float;
in vec3 mean; in vec4 colour; out vec4 tint;
${CAMERA}
void main() { tint = colour; gl_Position = clip(R * mean + t); }`, `#version 300 es
precision highp float;
in vec4 tint; out vec4 result;
void main() { result = vec4(tint.rgb * tint.a, tint.a); }`],
  picture: [`#version 300 es
precision highp float;
in vec3 mean; in vec2 corner; out vec2 at;
${CAMERA}
void main() { at = corner; gl_Position = clip(R * mean + t); }`, `#version 300 es
precision highp float;
in vec2 at; uniform sampler2D image; out vec4 result;
void main() { vec4 c = texture(image, at); result = vec4(c.rgb * c.a, c.a) * 0.92 + vec4(0.08); }`],
};

let gl, programs = {}, buffers = {};

function link(name) {
  const program = gl.createProgram();
  ["VERTEX_SHADER", "FRAGMENT_SHADER"].forEach((kind, i) => {
    const shader = gl.createShader(gl[kind]);
    gl.shaderSource(shader, SOURCES[name][i]);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(`${name}: ${gl.getShaderInfoLog(shader)}`);
    gl.attachShader(program, shader);
  });
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(`${name}: ${gl.getProgramInfoLog(program)}`);
  const uniforms = {};
  for (const key of ["R", "t", "focal", "centre", "size", "radius", "image"]) uniforms[key] = gl.getUniformLocation(program, key);
  return { program, uniforms };
}

function use(name, camera) {
  const { program, uniforms } = programs[name];
  gl.useProgram(program);
  gl.uniformMatrix3fv(uniforms.R, true, camera.R);
  for (const [key, call] of [["t", "uniform3fv"], ["focal", "uniform2fv"], ["centre", "uniform2fv"], ["size", "uniform2fv"]])
    gl[call](uniforms[key], camera[key]);
  return programs[name];
}

function attributes(name, array, layout, divisor) {
  const stride = 4 * layout.reduce((sum, [, width]) => sum + width, 0), { program } = programs[name];
  buffers[divisor] = buffers[divisor] || gl.createBuffer();
  gl.bindBuffer(gl.ARRAY_BUFFER, buffers[divisor]);
  gl.bufferData(gl.ARRAY_BUFFER, array, gl.DYNAMIC_DRAW);
  let offset = 0;
  for (const [key, width] of layout) {
    const place = gl.getAttribLocation(program, key);
    if (place >= 0) {
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, width, gl.FLOAT, false, stride, offset);
      gl.vertexAttribDivisor(place, divisor);
    }
    offset += 4 * width;
  }
}

const QUAD = new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]);

function drawInstances(name, camera, array, layout, count, radius) {
  const { uniforms } = use(name, camera);
  gl.bindVertexArray(gl.createVertexArray());
  const vao = gl.getParameter(gl.VERTEX_ARRAY_BINDING);
  if (radius) gl.uniform1f(uniforms.radius, radius);
  attributes(name, array, layout, 1);
  attributes(name, QUAD, [["corner", 2]], 0);
  gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
  gl.bindVertexArray(null);
  gl.deleteVertexArray(vao);
}

function drawPlain(name, camera, array, layout, mode, before) {
  const shader = use(name, camera);
  const vao = gl.createVertexArray();
  gl.bindVertexArray(vao);
  if (before) before(shader.uniforms);
  attributes(name, array, layout, 0);
  gl.drawArrays(mode, 0, array.length / layout.reduce((sum, [, width]) => sum + width, 0));
  gl.bindVertexArray(null);
  gl.deleteVertexArray(vao);
}

// Indices from far to near: a counting sort of the depths in 16 bits.
function farFirst(depths, count) {
  let low = Infinity, high = -Infinity;
  for (let k = 0; k < count; k++) {
    low = Math.min(low, depths[k]);
    high = Math.max(high, depths[k]);
  }
  const scale = 65535 / Math.max(high - low, 1e-9), places = new Uint32Array(65537), order = new Uint32Array(count);
  const keys = new Uint16Array(count);
  for (let k = 0; k < count; k++) {
    keys[k] = (high - depths[k]) * scale;  // cut to a whole number
    places[keys[k] + 1]++;
  }
  for (let i = 1; i <= 65536; i++) places[i] += places[i - 1];
  for (let k = 0; k < count; k++) order[places[keys[k]]++] = k;
  return order;
}

// ---- what is shown -------------------------------------------------------------------------------------------------

let data, shEach, opacities;
const motions = [], obstacles = [], textures = new Map();
const orbit = { target: [0.5, 0.2, 0.5], yaw: 0.45, pitch: 0.28, distance: 1.9 };
const state = { frame: 0, playing: false, clock: 0, last: 0, dirty: true };

function orbitCamera(width, height) {
  const { yaw, pitch, distance, target } = orbit;
  const eye = [Math.sin(yaw) * Math.cos(pitch), Math.sin(pitch), Math.cos(yaw) * Math.cos(pitch)].map((u, i) => target[i] + distance * u);
  const z = normal(minus(target, eye)), x = normal(cross(z, [0, 1, 0])), y = cross(z, x);
  const R = [...x, ...y, ...z], f = 1.25 * Math.min(height, width);
  return { R, t: product(R, eye).map((u) => -u), focal: [f, f], centre: [width / 2, height / 2], size: [width, height], eye };
}

function filmedCamera(view, width, height) {
  const m = view.viewmat, scale = Math.min(width / view.size[0], height / view.size[1]);
  const R = [m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]], t = [m[3], m[7], m[11]];
  const shift = [(width - scale * view.size[0]) / 2, (height - scale * view.size[1]) / 2];
  return {
    R, t, size: [width, height], eye: backwards(R, t.map((u) => -u)), focal: view.focal.map((f) => f * scale),
    centre: view.centre.map((c, i) => c * scale + shift[i]),
  };
}

const minus = (a, b) => a.map((u, i) => u - b[i]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const normal = (a) => a.map((u) => u / Math.hypot(...a));
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const product = (R, p) => [0, 3, 6].map((i) => R[i] * p[0] + R[i + 1] * p[1] + R[i + 2] * p[2]);
const backwards = (R, p) => [0, 1, 2].map((i) => R[i] * p[0] + R[i + 3] * p[1] + R[i + 6] * p[2]);

// RGB of every Gaussian as seen by the camera: spherical harmonics along the line of sight, in the axes of the fit.
function seenColours(means, eye, out, stride, offset) {
  const K = meta.gaussians.sh.components / 3, count = meta.gaussians.sh.count, basis = new Float64Array(16);
  for (let k = 0; k < count; k++) {
    let x = means[3 * k] - eye[0], y = means[3 * k + 1] - eye[1], z = means[3 * k + 2] - eye[2];
    const length = Math.hypot(x, y, z) || 1;
    x /= length; y /= length; z /= length;
    basis[0] = SH[0];
    if (K > 1) { basis[1] = -SH[1] * y; basis[2] = SH[1] * z; basis[3] = -SH[1] * x; }
    if (K > 4) {
      basis[4] = SH[2] * x * y; basis[5] = -SH[2] * y * z; basis[6] = SH[3] * (2 * z * z - x * x - y * y);
      basis[7] = -SH[2] * x * z; basis[8] = SH[4] * (x * x - y * y);
    }
    if (K > 9) {
      basis[9] = -SH[5] * y * (3 * x * x - y * y); basis[10] = SH[6] * x * y * z;
      basis[11] = -SH[7] * y * (4 * z * z - x * x - y * y); basis[12] = SH[8] * z * (2 * z * z - 3 * x * x - 3 * y * y);
      basis[13] = -SH[7] * x * (4 * z * z - x * x - y * y); basis[14] = SH[9] * z * (x * x - y * y);
      basis[15] = -SH[5] * x * (x * x - 3 * y * y);
    }
    for (let c = 0; c < 3; c++) {
      let sum = 0.5;
      for (let i = 0; i < K; i++) sum += basis[i] * shEach[k * 3 * K + 3 * i + c];
      out[offset + k * stride + c] = Math.min(Math.max(sum, 0), 1);
    }
  }
}

function mapped(map, share, out, at) {
  const i = 3 * Math.round(255 * Math.min(Math.max(share, 0), 1)), colours = meta.maps[map];
  for (let c = 0; c < 3; c++) out[at + c] = colours[i + c] / 255;
}

function drawSplats(camera, motion, other) {
  const count = meta.gaussians.opacities.count, t = state.frame, stride = 13;
  const means = motion.means.frame(t), root = motion.roots.frame(t), rows = new Float32Array(stride * count);
  const depths = new Float32Array(count), away = other && other.means.frame(t);
  for (let k = 0; k < count; k++) {
    const [a, b, c, d, e, f] = root.subarray(6 * k, 6 * k + 6), at = stride * k;
    for (let i = 0; i < 3; i++) rows[at + i] = means[3 * k + i];
    rows[at + 3] = a * a + b * b + c * c;
    rows[at + 4] = a * b + b * d + c * e;
    rows[at + 5] = a * c + b * e + c * f;
    rows[at + 6] = b * b + d * d + e * e;
    rows[at + 7] = b * c + d * e + e * f;
    rows[at + 8] = c * c + e * e + f * f;
    rows[at + 12] = opacities[k];
    depths[k] = camera.R[6] * means[3 * k] + camera.R[7] * means[3 * k + 1] + camera.R[8] * means[3 * k + 2];
    if (away) {
      const gap = Math.hypot(means[3 * k] - away[3 * k], means[3 * k + 1] - away[3 * k + 1], means[3 * k + 2] - away[3 * k + 2]);
      mapped("viridis", gap / other.reach, rows, at + 9);
    }
  }
  if (!away) seenColours(means, camera.eye, rows, stride, 9);
  const order = farFirst(depths, count), sorted = new Float32Array(rows.length);
  for (let k = 0; k < count; k++) sorted.set(rows.subarray(stride * order[k], stride * order[k] + stride), stride * k);
  gl.enable(gl.BLEND);
  gl.depthMask(false);
  drawInstances("splats", camera, sorted, [["mean", 3], ["covA", 3], ["covB", 3], ["colour", 4]], count);
  gl.depthMask(true);
  gl.disable(gl.BLEND);
}

function drawBalls(camera, motion, name) {
  const entry = motion.x.entry, rows = new Float32Array(7 * entry.count), known = motion.scalars[name];
  const map = name === "body" ? null : meta.quantities[name].map;
  motion.x.into(state.frame, rows, 7, 0);
  const values = known && known.values, from = state.frame * entry.count;
  for (let k = 0; k < entry.count; k++) {
    if (values && !map) rows.set(meta.bodies[values[from + k]].color, 7 * k + 3);
    else if (values) mapped(map, values[from + k] / 255, rows, 7 * k + 3);
    else rows.fill(0.7, 7 * k + 3, 7 * k + 6);
    rows[7 * k + 6] = 1;
  }
  drawInstances("balls", camera, rows, [["mean", 3], ["colour", 4]], entry.count, motion.radius);
}

function boxLines() {
  const rows = [], grey = [0.6, 0.6, 0.58, 1], pale = [0.84, 0.84, 0.82, 1];
  const line = (a, b, colour) => rows.push(...a, ...colour, ...b, ...colour);
  for (let i = 0; i <= 10; i++) {
    line([i / 10, 0, 0], [i / 10, 0, 1], i % 10 ? pale : grey);
    line([0, 0, i / 10], [1, 0, i / 10], i % 10 ? pale : grey);
  }
  for (const [x, z] of [[0, 0], [1, 0], [0, 1], [1, 1]]) line([x, 0, z], [x, 1, z], pale);
  for (const [a, b] of [[[0, 0], [1, 0]], [[1, 0], [1, 1]], [[1, 1], [0, 1]], [[0, 1], [0, 0]]]) line([a[0], 1, a[1]], [b[0], 1, b[1]], pale);
  return new Float32Array(rows);
}

function drawObstacles(camera) {
  for (const { corners, poses, color } of obstacles) {
    const m = poses[Math.min(state.frame, poses.length - 1)], rows = new Float32Array(7 * corners.length / 3);
    const placed = (i) => [0, 1, 2].map((r) => m[4 * r] * corners[i] + m[4 * r + 1] * corners[i + 1] + m[4 * r + 2] * corners[i + 2] + m[4 * r + 3]);
    for (let i = 0, at = 0; i < corners.length; i += 9) {
      const [a, b, c] = [placed(i), placed(i + 3), placed(i + 6)], u = minus(b, a), v = minus(c, a);
      const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
      const light = 0.8 + 0.2 * (0.35 * n[0] + 0.8 * n[1] + 0.5 * n[2]) / (Math.hypot(...n) || 1);
      for (const p of [a, b, c]) { rows.set([...p, ...color.map((part) => part * light), 1], at); at += 7; }
    }
    drawPlain("lines", camera, rows, [["mean", 3], ["colour", 4]], gl.TRIANGLES);
  }
}

// Names of several bodies above their particles.
function nameBodies(camera, motion, left) {
  if (!motion.scalars.body) return;
  const x = motion.x.frame(state.frame), owner = motion.scalars.body.values, ratio = window.devicePixelRatio || 1;
  meta.bodies.forEach(({ name, color }, body) => {
    const top = [0, -Infinity, 0];
    let count = 0;
    for (let k = 0; k < x.length / 3; k++) {
      if (owner[k] !== body) continue;
      count++;
      top[0] += x[3 * k];
      top[1] = Math.max(top[1], x[3 * k + 1]);
      top[2] += x[3 * k + 2];
    }
    const p = product(camera.R, [top[0] / count, top[1], top[2] / count]).map((u, i) => u + camera.t[i]);
    if (!(p[2] > NEAR)) return;
    const span = document.createElement("span"), at = [0, 1].map((i) => camera.focal[i] * p[i] / p[2] + camera.centre[i]);
    span.textContent = name;
    span.style.left = `${(at[0] + left) / ratio}px`;
    span.style.top = `${at[1] / ratio}px`;
    span.style.borderColor = `rgb(${color.map((part) => Math.round(255 * part))})`;
    byId("names").append(span);
  });
}

const DEPTH_OF_FRUSTUM = 0.16;

function frustum(view) {
  const m = view.viewmat, R = [m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]], t = [m[3], m[7], m[11]];
  const world = (p) => backwards(R, minus(p, t));
  const corner = (u, v) => world([(u * view.size[0] - view.centre[0]) / view.focal[0], (v * view.size[1] - view.centre[1]) / view.focal[1], 1].map((w) => w * DEPTH_OF_FRUSTUM));
  return { eye: world([0, 0, 0]), corners: [corner(0, 0), corner(1, 0), corner(0, 1), corner(1, 1)] };
}

function drawFrusta(camera) {
  const rows = [], colour = [0.2, 0.42, 0.75, 1];
  for (const view of meta.views) {
    const { eye, corners: [a, b, c, d] } = frustum(view);
    for (const [p, q] of [[eye, a], [eye, b], [eye, c], [eye, d], [a, b], [b, d], [d, c], [c, a]]) rows.push(...p, ...colour, ...q, ...colour);
    const texture = observed(view);
    if (!texture) continue;
    const quad = [[a, 0, 0], [b, 1, 0], [c, 0, 1], [d, 1, 1]].flatMap(([p, u, v]) => [...p, u, v]);
    gl.enable(gl.BLEND);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    drawPlain("picture", camera, new Float32Array(quad), [["mean", 3], ["corner", 2]], gl.TRIANGLE_STRIP, (u) => gl.uniform1i(u.image, 0));
    gl.disable(gl.BLEND);
  }
  if (rows.length) drawPlain("lines", camera, new Float32Array(rows), [["mean", 3], ["colour", 4]], gl.LINES);
}

// The image of a view at the frame, or the one before; decoded when it is first wanted.
function observed(view) {
  const step = meta.steps[state.frame], image = view.images.filter(([n]) => n <= step).pop() || view.images[0];
  if (!image) return null;
  const [, start, length] = image;
  if (!textures.has(start)) {
    textures.set(start, null);
    createImageBitmap(new Blob([data.subarray(start, start + length)], { type: "image/webp" })).then((image) => {
      const texture = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
      for (const key of ["TEXTURE_MIN_FILTER", "TEXTURE_MAG_FILTER"]) gl.texParameteri(gl.TEXTURE_2D, gl[key], gl.LINEAR);
      for (const key of ["TEXTURE_WRAP_S", "TEXTURE_WRAP_T"]) gl.texParameteri(gl.TEXTURE_2D, gl[key], gl.CLAMP_TO_EDGE);
      textures.set(start, texture);
      state.dirty = true;
    });
  }
  return textures.get(start);
}

// Where to look: the room that the first motion takes, from the side of the first camera.
function home() {
  const { low, high } = motions[0].x.entry, sides = minus(high, low);
  orbit.target = low.map((u, i) => 0.5 * (u + high[i]));
  orbit.distance = Math.min(Math.max(2.4 * Math.max(...sides), 0.6), 2.5);
  if (!meta.views.length) return;
  const m = meta.views[0].viewmat, eye = backwards([m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]], [-m[3], -m[7], -m[11]]);
  orbit.yaw = Math.atan2(eye[0] - orbit.target[0], eye[2] - orbit.target[2]) + 0.35;
}

// ---- controls ------------------------------------------------------------------------------------------------------

function shown() {
  const left = motions[+byId("left").value], right = byId("right").value;
  return { left, right: right === "" ? null : motions[+right], what: byId("show").value };
}

function drawPanel(motion, other, what, place) {
  const [x, width, height] = place;
  gl.viewport(x, 0, width, height);
  gl.scissor(x, 0, width, height);
  const chosen = byId("camera").value;
  const camera = chosen === "" ? orbitCamera(width, height) : filmedCamera(meta.views[+chosen], width, height);
  if (byId("box").checked) {
    gl.depthMask(false);  // soft bodies rest a little below the floor's lines
    drawPlain("lines", camera, boxLines(), [["mean", 3], ["colour", 4]], gl.LINES);
    gl.depthMask(true);
  }
  drawObstacles(camera);
  if (byId("frusta").checked && chosen === "") drawFrusta(camera);
  if (what === "seen" || what === "distance") {
    if (motion.means) drawSplats(camera, motion, what === "distance" && other && other.means ? other : null);
  } else drawBalls(camera, motion, what);
  nameBodies(camera, motion, x);
}

function draw() {
  const ratio = window.devicePixelRatio || 1, { left, right, what } = shown();
  const width = Math.max(2, Math.round(canvas.clientWidth * ratio)), height = Math.max(2, Math.round(canvas.clientHeight * ratio));
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
  byId("names").replaceChildren();
  gl.enable(gl.SCISSOR_TEST);
  gl.enable(gl.DEPTH_TEST);
  gl.scissor(0, 0, width, height);
  gl.clearColor(1, 1, 1, 1);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  if (right && what !== "distance") {
    const half = width >> 1;
    drawPanel(left, right, what, [0, half, height]);
    drawPanel(right, left, what, [half, width - half, height]);
  } else drawPanel(left, right, what, [0, width, height]);
  byId("time").value = state.frame;
  const milliseconds = 1e3 * meta.dt * meta.steps[state.frame];
  byId("clock").textContent = `${milliseconds.toFixed(0)} ms`;
  document.body.dataset.frame = state.frame;
}

function inUnits(value, unit) {
  const [factor, prefix] = unit !== "Pa" ? [1, ""] : Math.abs(value) >= 1e6 ? [1e6, "M"] : Math.abs(value) >= 1e3 ? [1e3, "k"] : [1, ""];
  return `${+(value / factor).toPrecision(4)}${unit ? ` ${prefix}${unit}` : ""}`;
}

function changed() {
  const { left, right, what } = shown(), both = right && what !== "distance";
  byId("labels").replaceChildren(...(both ? [left, right] : [left]).map((motion) => {
    const span = document.createElement("span");
    span.textContent = motion.title;
    return span;
  }));
  const notes = [];
  let legend = meta.quantities[what];
  if (what === "distance") {
    if (right && left.means && right.means) {
      right.reach = left.reach = gaps(left, right);
      legend = { label: `distance from ${right.title}`, unit: "mm", range: [0, 1e3 * right.reach], map: "viridis" };
    } else notes.unshift("Choose two motions with Gaussians to see their distance.");
  }
  for (const motion of both ? [left, right] : [left]) {
    if (what === "seen" && !motion.means) notes.unshift(`${motion.title} carries no Gaussians: show its particles.`);
    if (meta.quantities[what] && !motion.scalars[what]) notes.unshift(`${motion.title}: ${legend.label} is not known.`);
  }
  byId("message").textContent = [...notes, ...meta.limits].join("\n");
  byId("legend").hidden = !legend;
  if (legend) {
    byId("quantity").textContent = legend.label;
    byId("ends").replaceChildren(...[0, 0.5, 1].map((share) => {
      const span = document.createElement("span");
      span.textContent = inUnits(legend.range[0] + share * (legend.range[1] - legend.range[0]), legend.unit);
      return span;
    }));
    const context = byId("bar").getContext("2d"), colours = meta.maps[legend.map];
    for (let i = 0; i < 256; i++) {
      context.fillStyle = `rgb(${colours.slice(3 * i, 3 * i + 3)})`;
      context.fillRect(i, 0, 1, 14);
    }
  }
  state.dirty = true;
}

// Distance that 99 of 100 Gaussians of all frames do not exceed, rounded up [m].
function gaps(left, right) {
  const distances = [];
  for (let t = 0; t < meta.steps.length; t++) {
    const a = left.means.frame(t), b = right.means.frame(t);
    for (let k = 0; k < a.length; k += 9) distances.push(Math.hypot(a[k] - b[k], a[k + 1] - b[k + 1], a[k + 2] - b[k + 2]));
  }
  const most = Math.max(Float64Array.from(distances).sort()[Math.floor(0.99 * (distances.length - 1))], 1e-4);
  const power = 10 ** Math.floor(Math.log10(most));
  return [1, 1.5, 2, 3, 4, 5, 6, 8, 10].find((step) => step * power >= most * (1 - 1e-9)) * power;
}

function option(select, value, text) {
  select.append(new Option(text, value));
}

function controls() {
  motions.forEach((motion, i) => { option(byId("left"), i, motion.title); });
  option(byId("right"), "", "nothing");
  motions.forEach((motion, i) => { option(byId("right"), i, motion.title); });
  option(byId("show"), "seen", "Gaussians");
  option(byId("show"), "distance", "Gaussians by distance of both");
  if (meta.bodies.length) option(byId("show"), "body", "particles by body");
  for (const [name, { label }] of Object.entries(meta.quantities)) option(byId("show"), name, `particles by ${label}`);
  option(byId("camera"), "", "free");
  meta.views.forEach((view, i) => option(byId("camera"), i, `view ${view.number}`));
  const learned = motions.findIndex((motion) => motion.name === "neuma");
  byId("left").value = learned >= 0 ? learned : 0;
  byId("right").value = learned > 0 ? 0 : "";
  byId("time").max = meta.steps.length - 1;
  for (const id of ["left", "right", "show", "camera", "frusta", "box"]) byId(id).addEventListener("change", changed);
  byId("time").addEventListener("input", () => { state.playing = false; state.frame = +byId("time").value; label(); state.dirty = true; });
  byId("play").addEventListener("click", () => play(!state.playing));
  window.addEventListener("resize", () => { state.dirty = true; });
  byId("notes").hidden = !meta.notes.length;
  byId("notes").lastElementChild.textContent = meta.notes.join("\n");
  pointer();
}

function play(playing) {
  state.playing = playing;
  if (playing && state.frame === meta.steps.length - 1) state.frame = 0;
  state.clock = meta.dt * meta.steps[state.frame];
  label();
}

function label() { byId("play").textContent = state.playing ? "Pause" : "Play"; }

// Left button or one finger turns, right button or shift shifts, wheel or two fingers come closer.
function pointer() {
  const down = new Map();
  const free = () => { if (byId("camera").value !== "") { byId("camera").value = ""; changed(); } };
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); down.set(event.pointerId, [event.clientX, event.clientY]); });
  for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (event) => down.delete(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    const before = down.get(event.pointerId);
    if (!before) return;
    free();
    const now = [event.clientX, event.clientY], [dx, dy] = minus(now, before);
    if (down.size === 2) {
      const [other] = [...down].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
      orbit.distance *= Math.hypot(...minus(before, other)) / Math.max(Math.hypot(...minus(now, other)), 1);
    } else if (event.buttons & 2 || event.shiftKey) {
      const { R } = orbitCamera(1, 1), scale = orbit.distance / (1.25 * Math.min(canvas.clientWidth, canvas.clientHeight));
      orbit.target = orbit.target.map((u, i) => u - scale * (dx * R[i] + dy * R[3 + i]));
    } else {
      orbit.yaw -= 0.008 * dx;
      orbit.pitch = Math.min(Math.max(orbit.pitch + 0.008 * dy, -1.5), 1.5);
    }
    down.set(event.pointerId, now);
    state.dirty = true;
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    free();
    orbit.distance = Math.min(Math.max(orbit.distance * Math.exp(0.001 * event.deltaY), 0.15), 10);
    state.dirty = true;
  }, { passive: false });
}

function tick(now) {
  const passed = Math.min((now - state.last) / 1e3, 0.1);
  state.last = now;
  if (state.playing) {
    state.clock += passed * +byId("pace").value;
    const end = meta.dt * meta.steps[meta.steps.length - 1];
    if (state.clock > end + 0.03) state.clock = 0;
    let frame = 0;
    while (frame + 1 < meta.steps.length && meta.dt * meta.steps[frame + 1] <= state.clock) frame++;
    if (frame !== state.frame) { state.frame = frame; state.dirty = true; }
  }
  if (state.dirty) { state.dirty = false; draw(); }
  requestAnimationFrame(tick);
}

async function main() {
  gl = canvas.getContext("webgl2", { antialias: true, alpha: false });
  if (!gl) return fail("This browser has no WebGL 2: update it, or switch hardware acceleration on.");
  if (typeof DecompressionStream === "undefined") return fail("This browser cannot inflate data: update it (2023 or later).");
  data = await inflated();
  for (const name of Object.keys(SOURCES)) programs[name] = link(name);
  gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  shEach = new Frames(data, meta.gaussians.sh).frame(0);
  opacities = new Frames(data, meta.gaussians.opacities).frame(0);
  for (const motion of meta.motions) {
    const scalars = Object.fromEntries(Object.entries(motion.scalars).map(([name, entry]) => [name, new Frames(data, entry)]));
    motions.push({
      ...motion, scalars, x: new Frames(data, motion.x),
      means: motion.means ? new Frames(data, motion.means) : null, roots: motion.roots ? new Frames(data, motion.roots) : null,
    });
  }
  for (const each of meta.obstacles) obstacles.push({ ...each, corners: new Frames(data, each.corners).frame(0) });
  home();
  controls();
  changed();
  play(!matchMedia("(prefers-reduced-motion: reduce)").matches);
  document.body.dataset.state = "ready";
  requestAnimationFrame((now) => { state.last = now; tick(now); });
}

main().catch((error) => { fail(`The file cannot be shown: ${error.message}`); throw error; });
