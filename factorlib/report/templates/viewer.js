// The relighting viewer: a mesh of Lambert + GGX materials in a light of spherical Gaussian lobes.
//
// Frames: y-up, right-handed.  "ref" is the photo's camera turned y-up; the object stands in it, the light is turned in it,
// and the eye moves about the object's middle.  Lengths are in radii of the object.
//
// Diffuse:  k_d / pi * (v E(n) + B) at vertices, the irradiance E read from a small cube map.  k_d is the material's, or that of each vertex of a
//           painted part, while it has its own material.
// Specular: k_s * integral of L(i) D G1(i) G1(o) / (4 n.o) di, estimated at half vectors drawn from the visible normals
//           (Heitz 2018; as spherical caps, Dupuy and Benyoub 2023), for which each sample counts L(i) G1(i).  A sample reads
//           the light at the mip level whose texels are as large as the solid angle it stands for (Krivanek and Colbert 2008).
// While something moves, one sample is shown, the mirror direction read at the level of the whole lobe, as in a map filtered beforehand, of fewer
// pixels where frames are slow.  After that PASSES of them
// are averaged, each a little displaced within its pixel, and the texels are those of all these samples together, OVERLAP times as large (else a sun
// is seen by some pixels and not by their neighbours), so that what is shown tends to the integral.
// Shadows:  from each vertex some of K directions are hidden by the object (`sight`).  v is the share of E that comes from the others, B comes from
//           the hidden ones: all bounces, of surfaces that send k_d + k_s of what they get to all sides.  Of the specular part the share of the hidden
//           directions in a lobe of that roughness about the mirror direction is the light of what is met there.  Vertices are interpolated between.
(() => {
const QUICK = 1, PER_PASS = 8, PASSES = 128, SLOW_FRAME = 40, IRRADIANCE_FACE = 16, HALF_FIELD = 15 * Math.PI / 180, STANDING_BACK = 1.04 / Math.sin(HALF_FIELD);
const LEAST_ALPHA = 1e-3, BOUNCES = 6, OVERLAP = 8, OWN = "", WHITE = 0.9, BRIGHTEST = 0.02, METERED = 64;

// ── Numbers ──────────────────────────────────────────────────────────────────────────────────────────────────────────

const times = (a, b) => { // 3x3, row by row
  const out = new Array(9);
  for (let i = 0; i < 9; i++) out[i] = a[i - i % 3] * b[i % 3] + a[i - i % 3 + 1] * b[i % 3 + 3] + a[i - i % 3 + 2] * b[i % 3 + 6];
  return out;
};
const transposed = (m) => [m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]];
const about_y = (angle) => [Math.cos(angle), 0, Math.sin(angle), 0, 1, 0, -Math.sin(angle), 0, Math.cos(angle)];
const unit = (v) => { const n = Math.hypot(...v); return v.map((x) => x / n); };
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
// The two dimensions of Sobol's sequence, of which any 2^m points from a multiple of 2^m on are spread evenly.
const sobol = [(v) => v >>> 1, (v) => (v ^ (v >>> 1)) >>> 0].map((next) => (k) => {
  let sum = 0;
  for (let v = 2 ** 31; k > 0; k >>= 1, v = next(v)) if (k & 1) sum = (sum ^ v) >>> 0;
  return sum / 2 ** 32;
});

// Direction of texel centre (s, t) in [-1, 1] of a face of a cube map, in OpenGL's layout.
const face_direction = (face, s, t) => unit([[1, -t, -s], [-1, -t, s], [s, 1, t], [s, -1, -t], [s, -t, 1], [-s, -t, -1]][face]);

function each_texel(size, visit) {
  for (let face = 0, k = 0; face < 6; face++)
    for (let row = 0; row < size; row++)
      for (let column = 0; column < size; column++, k++) {
        const s = (2 * column + 1) / size - 1, t = (2 * row + 1) / size - 1;
        visit(k, face_direction(face, s, t), 4 / (size * size * Math.pow(1 + s * s + t * t, 1.5)));
      }
}

// The light as texels of a cube map, and its irradiance over pi by normal; both over `unit`, so that half floats hold them.
function drawn_light(light) {
  const size = light.face, lobes = light.lobes, radiance = new Float32Array(18 * size * size);
  const coarse = { size: Math.min(size, 32) }, block = size / coarse.size, n = coarse.size;
  coarse.flux = new Float64Array(18 * n * n); coarse.direction = [];
  let power = 0;
  each_texel(size, (k, d, area) => {
    add_radiance(lobes, ...d, radiance, k);
    const face = Math.floor(k / (size * size)), row = Math.floor(k / size) % size, column = k % size;
    const into = (face * n + Math.floor(row / block)) * n + Math.floor(column / block);
    for (let c = 0; c < 3; c++) { coarse.flux[3 * into + c] += area * radiance[3 * k + c]; power += area * radiance[3 * k + c]; }
  });
  each_texel(n, (k, d) => coarse.direction.push(d));
  const scale = power > 0 ? power / (12 * Math.PI) : 1, m = IRRADIANCE_FACE, irradiance = new Float32Array(18 * m * m);
  each_texel(m, (k, normal) => {
    for (let j = 0; j < coarse.direction.length; j++) {
      const d = coarse.direction[j], cos = normal[0] * d[0] + normal[1] * d[1] + normal[2] * d[2];
      if (cos > 0) for (let c = 0; c < 3; c++) irradiance[3 * k + c] += cos * coarse.flux[3 * j + c] / Math.PI;
    }
  });
  for (const values of [radiance, irradiance]) for (let k = 0; k < values.length; k++) values[k] = Math.min(values[k] / scale, 60000);
  return { unit: scale, size, radiance, irradiance };
}

// Points of the unit square for a pass, as cos phi, sin phi, u: each pass is spread evenly, and all of them together are.
function sample_points(pass) {
  const out = new Float32Array(3 * PER_PASS), half = 0.5 / (PER_PASS * PASSES);
  for (let j = 0; j < PER_PASS; j++) {
    const [u, v] = sobol.map((of) => of(pass * PER_PASS + j) + half), phi = 2 * Math.PI * v;
    out.set([Math.cos(phi), Math.sin(phi), u], 3 * j);
  }
  return out;
}

// ── Meshes ───────────────────────────────────────────────────────────────────────────────────────────────────────────

function unpacked(mesh) {
  const vertices = Float32Array.from(new Uint16Array(bytes(mesh.vertices)), (v) => v / 32767.5 - 1);
  const parts = mesh.parts.map((text) => new Uint32Array(bytes(text))), part = new Uint8Array(vertices.length / 3), sight = {};
  for (const [k, triangles] of parts.entries()) for (const vertex of triangles) part[vertex] = k;
  sight.directions = new Float32Array(bytes(mesh.sight.directions)); sight.counts = new Uint16Array(bytes(mesh.sight.counts));
  sight.hidden = new Uint8Array(bytes(mesh.sight.hidden));
  const met = bytes(mesh.sight.met);
  sight.met = met.byteLength > 2 * sight.hidden.length ? new Uint32Array(met) : new Uint16Array(met);
  const decoded = (v) => v <= 0.04045 ? v / 12.92 : Math.pow((v + 0.055) / 1.055, 2.4);
  const diffuse = mesh.diffuse === null ? null : Float32Array.from(new Uint8Array(bytes(mesh.diffuse)), (v) => decoded(v / 255));
  return { vertices, diffuse, normals: Float32Array.from(new Int16Array(bytes(mesh.normals)), (v) => v / 32767), parts, part, open: mesh.open, sight, name: mesh.name };
}

function ball(rows = 48, columns = 96) {
  const vertices = [], triangles = [];
  for (let i = 0; i <= rows; i++)
    for (let j = 0; j <= columns; j++) {
      const theta = Math.PI * i / rows, phi = 2 * Math.PI * j / columns;
      vertices.push(Math.sin(theta) * Math.sin(phi), Math.cos(theta), Math.sin(theta) * Math.cos(phi));
    }
  for (let i = 0; i < rows; i++)
    for (let j = 0; j < columns; j++) {
      const a = i * (columns + 1) + j, b = a + columns + 1;
      triangles.push(a, b, a + 1, a + 1, b, b + 1);
    }
  const position = new Float32Array(vertices);
  return { name: "a ball", photo: null, materials: [null], painted: [false], rotation: [1, 0, 0, 0, 1, 0, 0, 0, 1], eye: [0, 0, 1],
           mesh: { vertices: position, normals: position, parts: [new Uint32Array(triangles)] } };
}

// Light over `unit` in a mesh's directions; what is narrower than these lie apart is widened (factorlib.light.visibility).
function light_along(directions, lobes, unit, light_from_object) {
  const count = directions.length / 3, wide = lobes.slice(), out = new Float32Array(3 * count), integral = (s) => -Math.expm1(-2 * s) / s;
  for (let j = 0; j < wide.length; j += 7) {
    const sharpness = Math.max(lobes[j + 3], 1e-3);
    wide[j + 3] = 1 / (1 / sharpness + Math.PI / count);
    for (let c = 4; c < 7; c++) wide[j + c] *= integral(sharpness) / integral(wide[j + 3]) / unit;
  }
  for (let k = 0, m = light_from_object; k < count; k++) {
    const [x, y, z] = directions.subarray(3 * k, 3 * k + 3);
    add_radiance(wide, m[0] * x + m[1] * y + m[2] * z, m[3] * x + m[4] * y + m[5] * z, m[6] * x + m[7] * y + m[8] * z, out, k);
  }
  return out;
}

// By vertex v and B of above, and what the vertex sends: 3 numbers each; one more vertex is black.  light: along the directions;  materials: by part;
// painted: by part
function reaching({ normals, part, sight, diffuse }, light, materials, painted) {
  const n = normals.length / 3, { directions, counts, hidden, met } = sight, share = new Float32Array(3 * n).fill(1), bounced = new Float32Array(3 * n);
  const direct = new Float32Array(3 * n), sent = new Float32Array(3 * n + 3), weight = new Float32Array(hidden.length);
  for (let i = 0, pair = 0; i < n; i++) {
    const x = normals[3 * i], y = normals[3 * i + 1], z = normals[3 * i + 2];
    let all = 0, r = 0, g = 0, b = 0, hr = 0, hg = 0, hb = 0;
    for (let k = 0; k < directions.length; k += 3) {
      const cos = x * directions[k] + y * directions[k + 1] + z * directions[k + 2];
      if (cos > 0) { all += cos; r += cos * light[k]; g += cos * light[k + 1]; b += cos * light[k + 2]; }
    }
    for (const end = pair + counts[i]; pair < end; pair++) {
      const k = 3 * hidden[pair], cos = Math.max(0, x * directions[k] + y * directions[k + 1] + z * directions[k + 2]);
      weight[pair] = cos / all; hr += cos * light[k]; hg += cos * light[k + 1]; hb += cos * light[k + 2];
    }
    for (const [c, whole, lost] of [[0, r, hr], [1, g, hg], [2, b, hb]]) {
      share[3 * i + c] = whole > 0 ? Math.max(0, 1 - lost / whole) : 1; direct[3 * i + c] = Math.max(0, whole - lost) / all;
    }
  }
  const albedo = Float32Array.from({ length: 3 * n }, (_, k) => {
    const at = part[Math.floor(k / 3)], material = materials[at];
    return Math.min(1, (painted[at] ? diffuse[k] : material.diffuse[k % 3]) + material.specular[k % 3]);
  });
  for (let bounce = 0; bounce <= BOUNCES; bounce++) {
    for (let i = 0; i < n; i++) for (let c = 0; c < 3; c++) sent[3 * i + c] = albedo[3 * i + c] * (direct[3 * i + c] + bounced[3 * i + c]);
    if (bounce === BOUNCES) break;
    bounced.fill(0);
    for (let i = 0, pair = 0; i < n; i++)
      for (const end = pair + counts[i]; pair < end; pair++)
        for (let c = 0; c < 3; c++) bounced[3 * i + c] += weight[pair] * sent[3 * met[pair] + c];
  }
  return { share, bounced, sent };
}

// By vertex what the highlight reflects of the surfaces that it meets, over k_s, and how much of it is free: 4 numbers.  eye: in the object's frame;  alphas: by part
function mirrored({ vertices, normals, part, sight }, sent, eye, alphas) {
  const n = normals.length / 3, { directions, counts, hidden, met } = sight, out = new Float32Array(4 * n);
  for (let i = 0, pair = 0; i < n; i++) {
    const alpha = alphas[part[i]], a2 = alpha * alpha + 3 * Math.PI / directions.length, x = normals[3 * i], y = normals[3 * i + 1], z = normals[3 * i + 2];
    let ox = eye[0] - vertices[3 * i], oy = eye[1] - vertices[3 * i + 1], oz = eye[2] - vertices[3 * i + 2];
    const far = Math.hypot(ox, oy, oz), facing = (ox * x + oy * y + oz * z) / far;
    ox = 2 * facing * x - ox / far; oy = 2 * facing * y - oy / far; oz = 2 * facing * z - oz / far;
    let whole = 0, r = 0, g = 0, b = 0;
    for (const end = pair + counts[i]; pair < end; pair++) {
      const k = 3 * hidden[pair], j = 3 * met[pair], spread = 1 - (1 - a2) * (1 + ox * directions[k] + oy * directions[k + 1] + oz * directions[k + 2]) / 2;
      const part_of_lobe = 3 * a2 / directions.length / (spread * spread); // GGX about the half vector; over all directions the sum is 1
      whole += part_of_lobe; r += part_of_lobe * sent[j]; g += part_of_lobe * sent[j + 1]; b += part_of_lobe * sent[j + 2];
    }
    const most = Math.max(1, whole), cos = Math.max(facing, 1e-3), seen = 2 * cos / (cos + Math.sqrt(alpha * alpha + (1 - alpha * alpha) * cos * cos)) / most; // G1
    out.set([r * seen, g * seen, b * seen, 1 - whole / most], 4 * i);
  }
  return out;
}

// ── Shaders ──────────────────────────────────────────────────────────────────────────────────────────────────────────

const DEPTH_VERTEX = `#version 300 es
in vec3 position;
uniform mat3 ref_from_object; uniform mat4 clip_from_ref;
invariant gl_Position;
void main() { vec3 at = ref_from_object * position; gl_Position = clip_from_ref * vec4(at, 1.0); }`;
const SHADE_VERTEX = `#version 300 es
precision highp samplerCube;
in vec3 position, normal, share, bounced, diffuse; in vec4 mirrored;
uniform samplerCube irradiance;
uniform mat3 ref_from_object, light_from_ref; uniform mat4 clip_from_ref; uniform vec3 k_d, k_s; uniform bool painted;
out vec3 at, up; out vec4 lit;             // lit: all but the light mirrored from afar, and how much of that is free
invariant gl_Position;
void main() {
  at = ref_from_object * position; up = ref_from_object * normal; gl_Position = clip_from_ref * vec4(at, 1.0);
  lit = vec4((painted ? diffuse : k_d) * (share * textureLod(irradiance, light_from_ref * up, 0.0).rgb + bounced) + k_s * mirrored.rgb, mirrored.a);
}`;
const DEPTH = `#version 300 es
precision highp float; out vec4 colour;
void main() { colour = vec4(0.0); }`;
const SHADE = `#version 300 es
precision highp float; precision highp samplerCube;
in vec3 at, up; in vec4 lit; out vec4 colour;
uniform samplerCube radiance;
uniform mat3 light_from_ref; uniform vec3 eye, k_s, gain;
uniform float alpha, count, texel;      // of GGX; samples that lie apart; solid angle of a texel of level 0
uniform int each;                       // samples of this pass
uniform vec3 samples[${PER_PASS}];       // cos phi, sin phi, u
float smith(float c) { return 2.0 * c / (c + sqrt(alpha * alpha + (1.0 - alpha * alpha) * c * c)); }
void main() {
  vec3 n = normalize(up), o = normalize(eye - at);
  float facing = dot(n, o);
  if (facing < 0.0) { n = -n; facing = -facing; }    // the inside of an open mesh
  vec3 sum = vec3(0.0);
  if (max(k_s.r, max(k_s.g, k_s.b)) > 0.0) {
    facing = max(facing, 1e-3);
    vec3 t = o - n * dot(n, o); float across = length(t);
    t = across > 1e-5 ? t / across : normalize(abs(n.y) < 0.9 ? cross(n, vec3(0.0, 1.0, 0.0)) : cross(n, vec3(1.0, 0.0, 0.0)));
    vec3 b = cross(n, t), local = vec3(sqrt(max(0.0, 1.0 - facing * facing)), 0.0, facing), stretched = normalize(vec3(local.x * alpha, 0.0, local.z));
    float seen = smith(facing), a2 = alpha * alpha;
    mat3 light_from_local = light_from_ref * mat3(t, b, n);
    for (int k = 0; k < each; k++) {
      float z = (1.0 - samples[k].z) * (1.0 + stretched.z) - stretched.z, r = sqrt(max(0.0, 1.0 - z * z));
      vec3 h = vec3(r * samples[k].x, r * samples[k].y, z) + stretched;
      h = each == 1 ? vec3(0.0, 0.0, 1.0) : normalize(vec3(h.xy * alpha, max(h.z, 1e-6)));
      vec3 i = 2.0 * dot(local, h) * h - local;
      if (i.z <= 0.0) continue;
      float slope = h.z * h.z * (a2 - 1.0) + 1.0, density = seen * a2 / (3.14159265 * slope * slope) / (4.0 * facing);
      float level = 0.5 * log2(1.0 / (count * density * texel));
      sum += smith(i.z) * textureLod(radiance, light_from_local * i, max(level, 0.0)).rgb;
    }
    sum *= lit.a * k_s / float(each);
  }
  colour = vec4(gain * (sum + lit.rgb), 1.0);
}`;
const SCREEN_VERTEX = `#version 300 es
out vec2 uv;
void main() { uv = vec2(gl_VertexID == 1 ? 2.0 : 0.0, gl_VertexID == 2 ? 2.0 : 0.0); gl_Position = vec4(2.0 * uv - 1.0, 1.0, 1.0); }`;
const SKY = `#version 300 es
precision highp float; precision highp samplerCube;
in vec2 uv; out vec4 colour;
uniform samplerCube radiance; uniform mat3 light_from_ref, ref_from_eye; uniform vec3 gain; uniform float field;
void main() { colour = vec4(gain * textureLod(radiance, light_from_ref * ref_from_eye * vec3((2.0 * uv - 1.0) * field, -1.0), 0.0).rgb, 1.0); }`;
const COPY = `#version 300 es
precision highp float;
in vec2 uv; out vec4 colour; uniform sampler2D picture;
void main() { colour = texture(picture, uv); }`;
const SHOW = `#version 300 es
precision highp float;
in vec2 uv; out vec4 colour;
uniform sampler2D picture; uniform float exposure, passes;
vec3 encoded(vec3 v) { return mix(12.92 * v, 1.055 * pow(max(v, 1e-6), vec3(1.0 / 2.4)) - 0.055, step(0.0031308, v)); }
void main() { vec4 mean = texture(picture, uv) / passes; // radiance times coverage, coverage
  colour = vec4(encoded(clamp(exposure * mean.rgb / max(mean.a, 1e-6), 0.0, 1.0)) * mean.a, mean.a); }`;

function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text); gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  for (const [k, name] of ["position", "normal", "share", "bounced", "mirrored", "diffuse"].entries()) gl.bindAttribLocation(made, k, name);
  gl.linkProgram(made);
  const places = {};
  return { use: () => gl.useProgram(made), at: (name) => places[name] ??= gl.getUniformLocation(made, name) };
}

// The nearest level alone is read: in software a mixture of two costs twice as much, and the levels are small in the average.
function cube(gl, format, size, values, mips) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_CUBE_MAP, texture);
  const rgba = new Float32Array(4 * size * size);
  for (let face = 0; face < 6; face++) {
    for (let k = 0; k < size * size; k++) for (let c = 0; c < 3; c++) rgba[4 * k + c] = values[3 * (face * size * size + k) + c];
    gl.texImage2D(gl.TEXTURE_CUBE_MAP_POSITIVE_X + face, 0, format, size, size, 0, gl.RGBA, gl.FLOAT, rgba);
  }
  if (mips) gl.generateMipmap(gl.TEXTURE_CUBE_MAP);
  gl.texParameteri(gl.TEXTURE_CUBE_MAP, gl.TEXTURE_MIN_FILTER, mips ? gl.LINEAR_MIPMAP_NEAREST : gl.LINEAR);
  gl.texParameteri(gl.TEXTURE_CUBE_MAP, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
  return texture;
}

// ── The renderer ─────────────────────────────────────────────────────────────────────────────────────────────────────

class Renderer {
  // Throws where the browser has no WebGL 2 or cannot draw into floating point numbers.
  constructor(canvas, data) {
    this.canvas = canvas; this.data = data;
    const gl = this.gl = canvas.getContext("webgl2", { alpha: true, premultipliedAlpha: true, antialias: false });
    if (!gl) throw new Error("this browser offers no WebGL 2");
    const float = gl.getExtension("EXT_color_buffer_float"), blend = gl.getExtension("EXT_float_blend");
    if (!float && !gl.getExtension("EXT_color_buffer_half_float")) throw new Error("this browser cannot draw into floating point numbers");
    this.format = float && blend ? gl.RGBA32F : gl.RGBA16F;
    this.texels = float && gl.getExtension("OES_texture_float_linear") ? gl.RGBA32F : gl.RGBA16F; // in software the larger are read faster
    this.depth = program(gl, DEPTH_VERTEX, DEPTH); this.shade = program(gl, SHADE_VERTEX, SHADE);
    [this.sky, this.copy, this.show] = [SKY, COPY, SHOW].map((text) => program(gl, SCREEN_VERTEX, text));
    const meshes = data.meshes.map(unpacked);
    this.objects = [...data.objects.map((each) => ({ ...each, mesh: meshes[each.mesh] })), ball()];
    this.lights = new Map(); this.buffers = new Map(); this.empty = gl.createVertexArray();
  }

  light(name) {
    if (!this.lights.has(name)) {
      const drawn = drawn_light(this.data.lights[name]);
      this.lights.set(name, { unit: drawn.unit, size: drawn.size, radiance: cube(this.gl, this.texels, drawn.size, drawn.radiance, true),
                              irradiance: cube(this.gl, this.texels, IRRADIANCE_FACE, drawn.irradiance, false) });
    }
    return this.lights.get(name);
  }

  // The arrays of a mesh's parts, and a function that fills one of its attributes with numbers.
  buffer(mesh) {
    const gl = this.gl;
    if (this.buffers.has(mesh)) return this.buffers.get(mesh);
    const arrays = [mesh.vertices, mesh.normals, ...(mesh.sight ? [0, 0, 0] : []), ...(mesh.diffuse ? [0] : [])].map(() => gl.createBuffer());
    const parts = mesh.parts.map((triangles) => {
      const array = gl.createVertexArray();
      gl.bindVertexArray(array);
      for (const [k, buffer] of arrays.entries()) {
        gl.bindBuffer(gl.ARRAY_BUFFER, buffer); gl.enableVertexAttribArray(k); gl.vertexAttribPointer(k, k === 4 ? 4 : 3, gl.FLOAT, false, 0, 0);
      }
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer()); gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, triangles, gl.STATIC_DRAW);
      return { array, count: triangles.length };
    });
    const fill = (k, values) => { gl.bindBuffer(gl.ARRAY_BUFFER, arrays[k]); gl.bufferData(gl.ARRAY_BUFFER, values, gl.DYNAMIC_DRAW); };
    fill(0, mesh.vertices); fill(1, mesh.normals);
    if (mesh.diffuse) fill(5, mesh.diffuse);
    this.buffers.set(mesh, { parts, fill });
    return this.buffers.get(mesh);
  }

  // Fill what the light does at the vertices, and what is mirrored there, where either has changed; an object without `sight` hides nothing.
  shadow(state, materials, painted, eye, light, light_from_ref) {
    const { mesh, rotation } = state.object, { fill } = this.buffer(mesh);
    if (!mesh.sight) {
      for (const [k, value] of [[2, 1], [3, 0]]) this.gl.vertexAttrib3f(k, value, value, value);
      return this.gl.vertexAttrib4f(4, 0, 0, 0, 1);
    }
    const light_from_object = times(light_from_ref, rotation), lit = [state.photo.light, light_from_object, materials, painted].join();
    if (mesh.lit !== lit) {
      const along = light_along(mesh.sight.directions, this.data.lights[state.photo.light].lobes, light.unit, light_from_object);
      const found = reaching(mesh, along, materials.map((name) => this.data.materials[name]), painted);
      fill(2, found.share); fill(3, found.bounced);
      Object.assign(mesh, { lit, sent: found.sent, eye: null });
    }
    if (mesh.eye === eye.join()) return;
    mesh.eye = eye.join();
    const object_eye = [0, 1, 2].map((k) => rotation[k] * eye[0] + rotation[k + 3] * eye[1] + rotation[k + 6] * eye[2]);
    fill(4, mirrored(mesh, mesh.sent, object_eye, materials.map((name) => this.data.materials[name].roughness ** 2)));
  }

  // Two square pictures: one pass with its depths, and the sum of passes.
  targets(size) {
    const gl = this.gl;
    if (this.made?.size === size) return this.made;
    for (const old of this.made ? [this.made.one, this.made.sum] : []) { gl.deleteTexture(old.texture); gl.deleteFramebuffer(old.frame); }
    if (this.made) gl.deleteRenderbuffer(this.made.depth);
    const [one, sum] = [0, 1].map(() => {
      const texture = gl.createTexture(), frame = gl.createFramebuffer();
      gl.bindTexture(gl.TEXTURE_2D, texture); gl.texStorage2D(gl.TEXTURE_2D, 1, this.format, size, size);
      for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
      gl.bindFramebuffer(gl.FRAMEBUFFER, frame); gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
      return { texture, frame };
    });
    const depth = gl.createRenderbuffer();
    gl.bindRenderbuffer(gl.RENDERBUFFER, depth); gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, size, size);
    gl.bindFramebuffer(gl.FRAMEBUFFER, one.frame); gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, depth);
    return this.made = { size, one, sum, depth };
  }

  // Draw one pass.  count: of samples that will be averaged;  state: of the Viewer
  draw(state, size, pass, count) {
    const gl = this.gl, target = this.targets(size), light = this.light(state.photo.light), view = this.camera(state, count > QUICK ? pass : null, size);
    const light_from_ref = times(state.photo.rotation, about_y(-state.turn)), gain = state.photo.gain.map((g) => g * light.unit);
    const { parts } = this.buffer(state.object.mesh), materials = parts.map((_, k) => state.materials[k] || state.object.materials[k]);
    const painted = parts.map((_, k) => !state.materials[k] && state.object.painted[k]);
    this.shadow(state, materials, painted, view.eye, light, light_from_ref);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.one.frame); gl.viewport(0, 0, size, size);
    gl.clearColor(0, 0, 0, 0); gl.clear(gl.DEPTH_BUFFER_BIT | gl.COLOR_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST); gl.disable(gl.BLEND);
    if (state.object.mesh.open) gl.enable(gl.CULL_FACE); else gl.disable(gl.CULL_FACE);
    gl.activeTexture(gl.TEXTURE0); gl.bindTexture(gl.TEXTURE_CUBE_MAP, light.radiance);
    gl.activeTexture(gl.TEXTURE1); gl.bindTexture(gl.TEXTURE_CUBE_MAP, light.irradiance);
    const place = (shader) => {
      shader.use();
      gl.uniformMatrix3fv(shader.at("ref_from_object"), true, state.object.rotation);
      gl.uniformMatrix4fv(shader.at("clip_from_ref"), true, view.clip_from_ref);
    };
    place(this.depth); gl.depthFunc(gl.LEQUAL);
    for (const part of parts) { gl.bindVertexArray(part.array); gl.drawElements(gl.TRIANGLES, part.count, gl.UNSIGNED_INT, 0); }
    place(this.shade); gl.depthFunc(gl.EQUAL); // only what is seen is shaded
    const at = (name) => this.shade.at(name);
    gl.uniform1i(at("radiance"), 0); gl.uniform1i(at("irradiance"), 1); gl.uniformMatrix3fv(at("light_from_ref"), true, light_from_ref);
    gl.uniform3fv(at("eye"), view.eye); gl.uniform3fv(at("gain"), gain); gl.uniform3fv(at("samples"), sample_points(pass));
    gl.uniform1f(at("count"), count > QUICK ? count / OVERLAP : 1); gl.uniform1i(at("each"), Math.min(count, PER_PASS)); gl.uniform1f(at("texel"), 4 * Math.PI / (6 * light.size * light.size));
    for (const [k, part] of parts.entries()) {
      const material = this.data.materials[materials[k]];
      gl.uniform1i(at("painted"), painted[k] ? 1 : 0); gl.uniform3fv(at("k_d"), material.diffuse); gl.uniform3fv(at("k_s"), material.specular);
      gl.uniform1f(at("alpha"), Math.max(material.roughness * material.roughness, LEAST_ALPHA));
      gl.bindVertexArray(part.array); gl.drawElements(gl.TRIANGLES, part.count, gl.UNSIGNED_INT, 0);
    }
    if (!state.sky) return;
    this.sky.use(); // where the depth is still that of the far plane
    gl.uniform1i(this.sky.at("radiance"), 0); gl.uniformMatrix3fv(this.sky.at("light_from_ref"), true, light_from_ref);
    gl.uniformMatrix3fv(this.sky.at("ref_from_eye"), true, view.ref_from_eye); gl.uniform3fv(this.sky.at("gain"), gain);
    gl.uniform1f(this.sky.at("field"), Math.tan(HALF_FIELD) / state.zoom);
    gl.bindVertexArray(this.empty); gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // Draw a pass and add it to the sum, which pass 0 begins anew.
  add(state, size, pass) {
    const gl = this.gl;
    this.draw(state, size, pass, PER_PASS * PASSES);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.made.sum.frame);
    if (pass === 0) gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND); gl.blendFunc(gl.ONE, gl.ONE);
    this.screen(this.copy, this.made.one.texture);
    gl.disable(gl.BLEND);
  }

  screen(shader, texture) {
    const gl = this.gl;
    gl.disable(gl.DEPTH_TEST);
    gl.activeTexture(gl.TEXTURE0); gl.bindTexture(gl.TEXTURE_2D, texture);
    shader.use(); gl.uniform1i(shader.at("picture"), 0);
    gl.bindVertexArray(this.empty); gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // Show the sum of so many passes on the canvas, or without a number the pass that was drawn last.
  present(state, passes) {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null); gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    this.show.use();
    gl.uniform1f(this.show.at("passes"), passes ?? 1); gl.uniform1f(this.show.at("exposure"), state.exposure * Math.pow(2, state.stops));
    this.screen(this.show, passes ? this.made.sum.texture : this.made.one.texture);
  }

  // The exposure of 0 stops: the photo's, or less where more than the share BRIGHTEST of the object would be above WHITE, seen as in the photo.
  exposure(state) {
    const { object, photo } = state, gl = this.gl, key = [this.objects.indexOf(object), photo.name, ...state.materials].join();
    if (this.metered?.key !== key) {
      const start = { ...state, azimuth: 0, elevation: 0, turn: 0, zoom: 1, sky: false }, pixels = new Float32Array(4 * METERED * METERED), seen = [];
      this.draw(start, METERED, 0, QUICK);
      gl.readPixels(0, 0, METERED, METERED, gl.RGBA, gl.FLOAT, pixels);
      for (let k = 0; k < pixels.length; k += 4) if (pixels[k + 3] > 0) seen.push(Math.max(...pixels.subarray(k, k + 3)));
      const bright = seen.sort((a, b) => b - a)[Math.floor(BRIGHTEST * seen.length)];
      this.metered = { key, value: bright > 0 ? Math.min(photo.exposure, WHITE / bright) : photo.exposure };
    }
    return this.metered.value;
  }

  // Radiance times coverage, and coverage, of the finished picture: float32 RGBA, the lowest row first.
  radiance(state, size) {
    const gl = this.gl, pixels = new Float32Array(4 * size * size);
    for (let pass = 0; pass < PASSES; pass++) this.add(state, size, pass);
    gl.readPixels(0, 0, size, size, gl.RGBA, gl.FLOAT, pixels);
    return pixels.map((value) => value / PASSES);
  }

  // The eye and its projections; a pass is displaced within its pixel, null is not.
  camera(state, pass, size) {
    const azimuth = Math.atan2(state.object.eye[0], state.object.eye[2]) + state.azimuth, most = 0.4999 * Math.PI;
    const elevation = Math.max(-most, Math.min(most, Math.asin(state.object.eye[1]) + state.elevation));
    const back = [Math.sin(azimuth) * Math.cos(elevation), Math.sin(elevation), Math.cos(azimuth) * Math.cos(elevation)];
    const right = unit(cross([0, 1, 0], back)), up = cross(back, right), far = STANDING_BACK + 2, near = STANDING_BACK - 1.5;
    const f = state.zoom / Math.tan(HALF_FIELD);
    const [dx, dy] = pass === null ? [0, 0] : sobol.map((of) => 2 * (of(pass) + 0.5 / PASSES - 0.5) / size);
    const clip_from_ref = [
      ...right.map((r, k) => f * r - dx * back[k]), dx * STANDING_BACK, ...up.map((u, k) => f * u - dy * back[k]), dy * STANDING_BACK,
      ...back.map((b) => -b * (far + near) / (far - near)), STANDING_BACK * (far + near) / (far - near) - 2 * far * near / (far - near),
      ...back.map((b) => -b), STANDING_BACK];
    return { clip_from_ref, eye: back.map((b) => STANDING_BACK * b), ref_from_eye: transposed([...right, ...up, ...back]) };
  }
}


// ── The controls ─────────────────────────────────────────────────────────────────────────────────────────────────────

const title = (object) => object.photo === null ? object.name : `${object.photo} / ${object.name}`;

class Viewer {
  constructor(root, data) {
    this.root = root; this.canvas = root.querySelector("canvas");
    this.renderer = new Renderer(this.canvas, data); this.data = data;
    const control = (name) => root.querySelector(`[data-control=${name}]`);
    this.controls = Object.fromEntries(["object", "materials", "light", "turn", "stops", "sky", "reset"].map((name) => [name, control(name)]));
    const { object, light } = this.controls;
    for (const each of this.renderer.objects) object.add(new Option(title(each)));
    for (const photo of data.photos) light.add(new Option(photo.name));
    for (const each of Object.values(this.controls)) each.addEventListener("input", () => this.changed());
    this.controls.reset.addEventListener("click", () => this.reset());
    object.addEventListener("input", () => this.dress());
    this.dress();
    Object.assign(this, { scale: 1, was_quick: false, seen: false });
    this.listen();
    this.reset();
    new ResizeObserver(() => this.changed()).observe(this.canvas);
    new IntersectionObserver((entries) => { this.seen = entries.at(-1).isIntersecting; this.changed(); }).observe(this.canvas);
    document.addEventListener("visibilitychange", () => this.changed());
  }

  reset() {
    Object.assign(this, { azimuth: 0, elevation: 0, zoom: 1 });
    for (const name of ["turn", "stops"]) this.controls[name].value = 0;
    this.changed();
  }

  // A control for the material of each part of the object; a ball has no material of its own.
  dress() {
    const object = this.renderer.objects[this.controls.object.selectedIndex];
    this.controls.materials.replaceChildren(...object.materials.map((own, k) => {
      const label = document.createElement("label"), select = document.createElement("select");
      label.append(own === null ? "Material" : `Material of ${own} part`, select);
      if (own !== null) select.add(new Option(object.photo === null ? `${own}, its own` : `${own}, as in the photo`, OWN));
      for (const name of Object.keys(this.data.materials)) select.add(new Option(name));
      return label;
    }));
    this.changed();
  }

  // What is chosen: object, materials of its parts (OWN: as in the photo), photo whose light it is in; azimuth, elevation, turn of the light (radians), zoom, stops of exposure, sky;
  // and the exposure of 0 stops.
  state() {
    const { object, materials, light, turn, stops, sky } = this.controls;
    const state = { object: this.renderer.objects[object.selectedIndex], materials: [...materials.querySelectorAll("select")].map((select) => select.value), photo: this.data.photos[light.selectedIndex], azimuth: this.azimuth, elevation: this.elevation,
             zoom: this.zoom, turn: turn.value * Math.PI / 180, stops: Number(stops.value), sky: sky.checked };
    return { ...state, exposure: this.renderer.exposure(state) };
  }

  changed() {
    this.pass = -1; // -1: one quick pass is due; then 0 ... PASSES - 1 are averaged
    this.pending ??= requestAnimationFrame((now) => this.frame(now));
  }

  frame(now) {
    this.pending = null;
    if (document.hidden || !this.seen || this.canvas.clientWidth === 0) return; // nobody sees it
    const state = this.state(), quick = this.pass < 0;
    if (quick && this.was_quick) this.adapt(now - this.drawn_at);
    Object.assign(this, { was_quick: quick, drawn_at: now });
    const whole = this.canvas.clientWidth * Math.min(window.devicePixelRatio || 1, 2), size = Math.max(64, Math.round(whole * (quick ? this.scale : 1)));
    if (quick || this.pass + 1 >= PASSES / 2) this.resize(size);
    if (quick) { this.renderer.draw(state, size, 0, QUICK); this.renderer.present(state); this.tell(state); this.link(state); }
    else {
      this.renderer.add(state, size, this.pass);
      if (this.pass + 1 >= PASSES / 2) this.renderer.present(state, this.pass + 1);
    }
    this.root.querySelector("[data-refining]").style.visibility = ++this.pass < PASSES ? "visible" : "hidden";
    if (this.pass < PASSES) this.pending = requestAnimationFrame((next) => this.frame(next));
  }

  // Half as many pixels each way while frames of a movement are slow, and back when they are fast.
  adapt(milliseconds) {
    if (milliseconds > SLOW_FRAME) this.scale = Math.max(0.25, this.scale / 2);
    else if (milliseconds < SLOW_FRAME / 2) this.scale = Math.min(1, this.scale * 2);
  }

  resize(size) { if (this.canvas.width !== size) this.canvas.width = this.canvas.height = size; }

  tell(state) {
    const degrees = (angle) => `${Math.round(angle * 180 / Math.PI)}°`;
    const what = `${title(state.object)} of ${state.materials.map((name, k) => name || state.object.materials[k]).join(" and ")}`;
    this.canvas.setAttribute("aria-label", `${what} in the light of ${state.photo.name}, seen from ${degrees(state.azimuth)} to the right and ` +
      `${degrees(state.elevation)} above, the light turned by ${degrees(state.turn)}`);
    for (const name of ["turn", "stops"]) {
      const value = Number(this.controls[name].value);
      this.root.querySelector(`[data-value=${name}]`).textContent = (value > 0 ? "+" : "") + value + (name === "turn" ? "°" : " stops");
    }
    const darker = Math.log2(state.photo.exposure / state.exposure);
    this.root.querySelector("[data-metered]").textContent = darker < 0.05 ? "0 is the exposure of the light's photo." :
      `0 is ${darker.toFixed(1)} stops below the light's photo, so that this object does not burn out.`;
  }

  // Links to the files of what is shown, as far as the page has them; the photo's scene only while object, materials and light are the photo's.
  link({ object, materials, photo, turn }) {
    const as_in_photo = object.photo === photo.name && turn === 0 && materials.every((name, k) => name === OWN || name === object.materials[k]);
    const scene = `scenes/${photo.name}.xml`, files = [`${object.mesh.name}.glb`, `illumination/${photo.light}.exr`, ...(as_in_photo ? [scene] : []), "materials.json"];
    if (files.join() === this.linked) return;
    this.linked = files.join();
    const there = [...document.querySelectorAll("#summary .files a")], found = files.map((file) => there.find((a) => decodeURIComponent(a.getAttribute("href")) === `../export/${file}`));
    this.root.querySelector("[data-files]").replaceChildren(...found.filter(Boolean).map((link) => {
      const copy = link.cloneNode(), file = decodeURIComponent(link.getAttribute("href"));
      copy.textContent = file.endsWith(scene) ? `scene of ${photo.name}` : file.split("/").at(-1);
      return copy;
    }));
  }

  orbit(right, upward) {
    this.azimuth += right; this.elevation = Math.max(-1.5, Math.min(1.5, this.elevation + upward));
    this.changed();
  }

  zoomed(factor) { this.zoom = Math.max(0.3, Math.min(8, this.zoom * factor)); this.changed(); }

  listen() {
    const canvas = this.canvas, step = Math.PI / 36;
    const keys = { ArrowLeft: () => this.orbit(-step, 0), ArrowRight: () => this.orbit(step, 0), ArrowUp: () => this.orbit(0, step), ArrowDown: () => this.orbit(0, -step),
                   "+": () => this.zoomed(1.1), "=": () => this.zoomed(1.1), "-": () => this.zoomed(1 / 1.1), Home: () => this.reset() };
    canvas.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || !keys[event.key]) return;
      event.preventDefault(); keys[event.key]();
    });
    canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); canvas.focus(); });
    canvas.addEventListener("pointermove", (event) => {
      if (canvas.hasPointerCapture(event.pointerId)) this.orbit(-event.movementX / canvas.clientWidth * Math.PI, event.movementY / canvas.clientWidth * Math.PI);
    });
    canvas.addEventListener("wheel", (event) => { // only after a click, so that the page scrolls past
      if (document.activeElement !== canvas) return;
      event.preventDefault(); this.zoomed(Math.exp(-event.deltaY / 500));
    }, { passive: false });
    canvas.addEventListener("webglcontextlost", (event) => { event.preventDefault(); this.pending = 0; }); // 0: no frame is asked for
    canvas.addEventListener("webglcontextrestored", () => { this.renderer = new Renderer(canvas, this.data); this.pending = null; this.changed(); });
  }

  // Seconds a quick pass takes at a size, waiting for the last pixel: for measurements.
  seconds(frames, size) {
    const gl = this.renderer.gl, state = this.state(), pixel = new Float32Array(4), began = performance.now();
    for (let k = 0; k < frames; k++) {
      this.renderer.draw({ ...state, azimuth: state.azimuth + k / frames }, size, 0, QUICK); this.renderer.present(state);
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.renderer.made.one.frame); gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.FLOAT, pixel);
    }
    return (performance.now() - began) / 1000 / frames;
  }
}

const root = document.getElementById("viewer");
if (!viewer_data) return;
try {
  window.viewer = new Viewer(root, viewer_data);
  root.hidden = false; document.getElementById("viewer-missing").hidden = true;
  window.viewer.changed();
} catch (error) {
  document.getElementById("viewer-missing").textContent = `There is no relighting here: ${error.message}. The pictures below need nothing of the kind.`;
}
})();
