// A small WebGL2 renderer of skinned Gaussians. It draws what the bench's own renderer draws (ihbench/render/splat.py):
// opaque circles of variance (f s / z)² + LOW_PASS px², or footprints J R Σ Rᵀ Jᵀ + LOW_PASS of general ones; alpha
// min(largest, opacity exp(-dᵀ Σ⁻¹ d / 2)) down to one grey level; back to front. Gaussians are posed in the vertex
// shader, means and covariances, by a blend of 24 joints' transforms; their colours may be spherical harmonics of the
// direction of view in the world, with the signs and the order of ihbench/render/spherical_harmonics.py.

const NEAR = 0.01, LOW_PASS = 0.3, CLAMP = 0.3, JOINTS = 24, ROW = 1024;
const ALPHA_MAX = { opaque: 0.999, general: 0.99 };

const VERTEX = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;
uniform sampler2D places;    // x y z of the rest pose, and the scale, m
uniform usampler2D skins;    // four joints, their four weights, colour and label; 8 bits each
uniform sampler2D shapes;    // of general ones, side by side: xx xy xz yy, and yz zz opacity, m²
uniform sampler2D harmonics; // the K colours above degree 0 of one after the other, 127 of 255 is 0
uniform int degree;
uniform vec3 tone;           // colours: the least and the range; harmonics: what 254 of 255 stands for
uniform vec3 eye;            // m, world
uniform bool general;
uniform bool turning;        // harmonics are of directions at rest
uniform vec4 joints[${3 * JOINTS}];
uniform vec4 view[3];        // world to camera, row by row
uniform vec4 lens;           // fx fy cx cy, px
uniform float skew;
uniform float grain;          // m of the finest detail there is: a training pixel's; 0 for as the camera sees it
uniform vec2 size;           // px
uniform int tinted;          // bit k: label k is painted over; bit 8: surface that a painter made
in uint number;
out vec2 offset;
flat out vec3 inverse;       // of the footprint: xx, xy, yy
flat out float opacity;
flat out vec3 colour;
vec4 bytes(uint four) {
  return vec4(four & 255u, (four >> 8) & 255u, (four >> 16) & 255u, four >> 24);
}
const vec3 TINTS[5] = vec3[5](vec3(.6), vec3(0., .620, .451), vec3(.835, .369, 0.), vec3(.8, .475, .655), vec3(.902, .624, 0.));
vec3 harmonic(int k) {  // k = 1 is the first of degree 1
  int at = int(number) * ((degree + 1) * (degree + 1) - 1) + k - 1;
  return (texelFetch(harmonics, ivec2(at % ${ROW}, at / ${ROW}), 0).rgb * 255. / 127. - 1.) * tone.z;
}
vec3 shade(vec3 d) {
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  vec3 sum = .4886025119029199 * (z * harmonic(2) - y * harmonic(1) - x * harmonic(3));
  if (degree > 1) sum += 1.0925484305920792 * (x * y * harmonic(4) - y * z * harmonic(5) - x * z * harmonic(7))
    + .31539156525252005 * (2. * zz - xx - yy) * harmonic(6) + .5462742152960396 * (xx - yy) * harmonic(8);
  if (degree > 2) sum += 2.890611442640554 * x * y * z * harmonic(10) + .3731763325901154 * z * (2. * zz - 3. * xx - 3. * yy) * harmonic(12)
    - .4570457994644658 * (4. * zz - xx - yy) * (y * harmonic(11) + x * harmonic(13)) + 1.445305721320277 * z * (xx - yy) * harmonic(14)
    - .5900435899266435 * (y * (3. * xx - yy) * harmonic(9) + x * (xx - 3. * yy) * harmonic(15));
  return sum;
}
void main() {
  ivec2 at = ivec2(number % ${ROW}u, number / ${ROW}u);
  vec4 place = texelFetch(places, at, 0);
  uvec4 skin = texelFetch(skins, at, 0);
  vec4 rest = vec4(place.xyz, 1.), weights = bytes(skin.y) / 255.;
  uvec4 bones = uvec4(bytes(skin.x));
  mat3x4 blend = mat3x4(0.);  // its columns are the rows of the transform
  for (int k = 0; k < 4; k++) {
    int j = 3 * int(bones[k]);
    blend += weights[k] * mat3x4(joints[j], joints[j + 1], joints[j + 2]);
  }
  vec4 world = vec4(rest * blend, 1.);
  vec3 p = vec3(dot(view[0], world), dot(view[1], world), dot(view[2], world));
  vec4 look = bytes(skin.z);
  int label = int(look.w);
  colour = tone.x + tone.y * look.rgb / 255.;
  mat3 back = mat3(blend[0].xyz, blend[1].xyz, blend[2].xyz);  // the transposed transform
  if (degree > 0) colour = max(colour + shade(normalize(turning ? back * (world.xyz - eye) : world.xyz - eye)), 0.);
  int part = label & 3;
  if ((label & 4) != 0 && (tinted & 256) != 0) part = 4;
  else if ((tinted & (1 << part)) == 0) part = -1;
  if (part >= 0) colour = mix(colour, TINTS[part], .62);
  vec3 footprint;  // xx, xy, yy, px²
  if (general) {
    ivec2 two = ivec2(2 * at.x, at.y);
    vec4 a = texelFetch(shapes, two, 0), b = texelFetch(shapes, two + ivec2(1, 0), 0);
    opacity = b.z;
    mat3 shape = mat3(a.x, a.y, a.z, a.y, a.w, b.x, a.z, b.x, b.y);
    mat3 turn = transpose(mat3(view[0].xyz, view[1].xyz, view[2].xyz)) * transpose(back);
    vec2 beyond = ${CLAMP} * size / (2. * lens.xy);
    vec2 along = clamp(p.xy / p.z, -lens.zw / lens.xy - beyond, (size - lens.zw) / lens.xy + beyond);
    vec3 across = vec3(lens.x, skew, -lens.x * along.x - skew * along.y) / p.z, down = vec3(0., lens.y, -lens.y * along.y) / p.z;
    mat3 spread = turn * shape * transpose(turn);
    footprint = vec3(dot(across, spread * across), dot(across, spread * down), dot(down, spread * down));
  } else {
    opacity = 1.;
    float v = place.w * place.w * lens.x * lens.y / (p.z * p.z);
    footprint = vec3(v, 0., v);
  }
  float fine = max(1., grain * sqrt(lens.x * lens.y) / p.z);  // px that a training pixel covers, if it is larger
  footprint += ${LOW_PASS} * fine * fine * vec3(1., 0., 1.);
  float area = footprint.x * footprint.z - footprint.y * footprint.y;
  inverse = vec3(footprint.z, -footprint.y, footprint.x) / area;
  vec2 reach = sqrt(2. * log(max(255. * opacity, 1.)) * footprint.xz) + .5;
  vec2 corner = vec2(float(gl_VertexID & 1), float(gl_VertexID >> 1)) * 2. - 1.;
  offset = corner * reach;
  vec2 pixel = vec2((lens.x * p.x + skew * p.y) / p.z + lens.z, lens.y * p.y / p.z + lens.w) + offset;
  gl_Position = p.z > ${NEAR} && area > 0. ? vec4(2. * pixel.x / size.x - 1., 1. - 2. * pixel.y / size.y, 0., 1.) : vec4(2., 2., 2., 1.);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
in vec2 offset;
flat in vec3 inverse;
flat in float opacity;
flat in vec3 colour;
uniform float largest;
out vec4 drawn;
void main() {
  vec2 d = offset;
  float alpha = min(largest, opacity * exp(-.5 * (inverse.x * d.x * d.x + 2. * inverse.y * d.x * d.y + inverse.z * d.y * d.y)));
  if (alpha < 1. / 255.) discard;
  drawn = vec4(colour * alpha, alpha);
}`;

class Splats {
  // Throws where there is no WebGL2. `lost` is called when the context goes away.
  constructor(canvas, lost) {
    this.canvas = canvas;
    const gl = canvas.getContext("webgl2", { antialias: false, depth: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("this browser has no WebGL2");
    canvas.addEventListener("webglcontextlost", (event) => { event.preventDefault(); lost("the graphics context was lost"); });
    this.gl = gl;
    const shader = (kind, text) => {
      const one = gl.createShader(kind);
      gl.shaderSource(one, text);
      gl.compileShader(one);
      if (!gl.getShaderParameter(one, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(one) ?? "no shader");
      return one;
    };
    this.program = gl.createProgram();
    gl.attachShader(this.program, shader(gl.VERTEX_SHADER, VERTEX));
    gl.attachShader(this.program, shader(gl.FRAGMENT_SHADER, FRAGMENT));
    gl.linkProgram(this.program);
    if (!gl.getProgramParameter(this.program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(this.program) ?? "no program");
    gl.useProgram(this.program);
    this.at = Object.fromEntries(["places", "skins", "shapes", "harmonics", "degree", "tone", "eye", "general", "turning", "largest", "joints", "view", "lens",
      "skew", "grain", "size", "tinted"].map((name) => [name, gl.getUniformLocation(this.program, name)]));
    gl.uniform1i(this.at.places, 0);
    gl.uniform1i(this.at.skins, 1);
    gl.uniform1i(this.at.shapes, 2);
    gl.uniform1i(this.at.harmonics, 3);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  }

  // `avatar`: count, rest [3n], bones [4n], weights [4n], colours [3n], labels [n]; scales [n] of circles, or shapes
  // [8n] of general ones, as the shader has them; degree, harmonics [3Kn] above it, tone [3] as the shader has it
  load(avatar) {
    const { gl } = this;
    this.avatar = avatar;
    const rows = Math.ceil(avatar.count / ROW);
    const places = new Float32Array(4 * ROW * rows);
    const skins = new Uint32Array(4 * ROW * rows);
    const four = (a, b, c, d) => (a | (b << 8) | (c << 16) | (d << 24)) >>> 0;
    for (let i = 0; i < avatar.count; i++) {
      for (let k = 0; k < 3; k++) places[4 * i + k] = avatar.rest[3 * i + k];
      places[4 * i + 3] = avatar.shapes ? 0 : avatar.scales[i];
      skins[4 * i] = four(...avatar.bones.subarray(4 * i, 4 * i + 4));
      skins[4 * i + 1] = four(...avatar.weights.subarray(4 * i, 4 * i + 4));
      skins[4 * i + 2] = four(...avatar.colours.subarray(3 * i, 3 * i + 3), avatar.labels[i]);
    }
    const texture = (unit, inner, format, kind, data, width = ROW, height = rows) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
      gl.texImage2D(gl.TEXTURE_2D, 0, inner, width, height, 0, format, kind, data);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    };
    texture(0, gl.RGBA32F, gl.RGBA, gl.FLOAT, places);
    texture(1, gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT, skins);
    const shapes = new Float32Array(avatar.shapes ? 8 * ROW * rows : 8 * rows); // never empty: a shader asks for it
    if (avatar.shapes) shapes.set(avatar.shapes);
    texture(2, gl.RGBA32F, gl.RGBA, gl.FLOAT, shapes, avatar.shapes ? 2 * ROW : 2);
    const above = avatar.harmonics.length / 3;
    const shades = new Uint8Array(4 * ROW * Math.max(1, Math.ceil(above / ROW)));
    for (let i = 0; i < above; i++) shades.set(avatar.harmonics.subarray(3 * i, 3 * i + 3), 4 * i);
    texture(3, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, shades, ROW, shades.length / 4 / ROW);
    gl.uniform1i(this.at.degree, avatar.degree);
    gl.uniform3fv(this.at.tone, avatar.tone);
    gl.uniform1i(this.at.general, avatar.shapes ? 1 : 0);
    gl.uniform1i(this.at.turning, avatar.turning ? 1 : 0);
    gl.uniform1f(this.at.largest, avatar.shapes ? ALPHA_MAX.general : ALPHA_MAX.opaque);
    this.order = new Uint32Array(avatar.count);
    this.keys = new Uint16Array(avatar.count);
    this.depths = new Float32Array(avatar.count);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    const number = gl.getAttribLocation(this.program, "number");
    gl.enableVertexAttribArray(number);
    gl.vertexAttribIPointer(number, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(number, 1);
  }

  // joints [12 × 24], rows of the transforms from rest to world; camera: R [9], t [3], fx fy cx cy skew width height, and
  // grain: Gaussians learn under the blur of a training pixel, and show gaps where they are drawn finer without it
  draw(joints, camera, tinted = 0) {
    const { gl, at, canvas } = this;
    if (gl.isContextLost()) return;
    if (canvas.width !== camera.width || canvas.height !== camera.height) {
      canvas.width = camera.width;
      canvas.height = camera.height;
    }
    gl.viewport(0, 0, camera.width, camera.height);
    gl.uniform4fv(at.joints, joints);
    const { R, t } = camera;
    gl.uniform4fv(at.view, [R[0], R[1], R[2], t[0], R[3], R[4], R[5], t[1], R[6], R[7], R[8], t[2]]);
    gl.uniform3fv(at.eye, [0, 1, 2].map((k) => -(R[k] * t[0] + R[3 + k] * t[1] + R[6 + k] * t[2])));
    gl.uniform4f(at.lens, camera.fx, camera.fy, camera.cx, camera.cy);
    gl.uniform1f(at.skew, camera.skew);
    gl.uniform1f(at.grain, camera.grain ?? 0);
    gl.uniform2f(at.size, camera.width, camera.height);
    gl.uniform1i(at.tinted, tinted);
    this.sort(joints, camera);
    gl.bufferData(gl.ARRAY_BUFFER, this.order, gl.DYNAMIC_DRAW);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.avatar.count);
  }

  // From back to front, by counting 16-bit depths; equal ones by their numbers, the first in front.
  sort(joints, { R, t }) {
    const { count, rest, bones, weights } = this.avatar;
    const row = new Float32Array(4 * JOINTS); // what a joint adds to a point's depth
    for (let j = 0; j < JOINTS; j++) {
      for (let c = 0; c < 4; c++) {
        row[4 * j + c] = R[6] * joints[12 * j + c] + R[7] * joints[12 * j + 4 + c] + R[8] * joints[12 * j + 8 + c];
      }
    }
    const { depths, keys, order } = this;
    let low = Infinity, high = -Infinity;
    for (let i = 0; i < count; i++) {
      const x = rest[3 * i], y = rest[3 * i + 1], z = rest[3 * i + 2];
      let depth = t[2];
      for (let k = 4 * i; k < 4 * i + 4; k++) {
        const w = weights[k];
        if (w === 0) continue;
        const j = 4 * bones[k];
        depth += w / 255 * (row[j] * x + row[j + 1] * y + row[j + 2] * z + row[j + 3]);
      }
      depths[i] = depth;
      if (depth < low) low = depth;
      if (depth > high) high = depth;
    }
    const scale = 65535 / Math.max(high - low, 1e-6);
    const starts = new Uint32Array(65537);
    for (let i = 0; i < count; i++) {
      keys[i] = 65535 - (depths[i] - low) * scale;
      starts[keys[i] + 1]++;
    }
    for (let k = 0; k < 65536; k++) starts[k + 1] += starts[k];
    for (let i = count - 1; i >= 0; i--) order[starts[keys[i]]++] = i;
  }

  // [4 × width × height] premultiplied RGBA as drawn, the top row first
  pixels() {
    const { gl, canvas } = this;
    const out = new Uint8Array(4 * canvas.width * canvas.height);
    gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, out);
    const flipped = new Uint8Array(out.length);
    const line = 4 * canvas.width;
    for (let y = 0; y < canvas.height; y++) flipped.set(out.subarray(y * line, (y + 1) * line), (canvas.height - 1 - y) * line);
    return flipped;
  }

  close() {
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
  }
}

// --- posing ---

// [9] of an axis-angle vector, row by row
function rotation(x, y, z) {
  const angle = Math.hypot(x, y, z);
  if (angle < 1e-9) return [1, -z, y, z, 1, -x, -y, x, 1];
  const [u, v, w] = [x / angle, y / angle, z / angle];
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  const d = 1 - c;
  return [c + u * u * d, u * v * d - w * s, u * w * d + v * s, u * v * d + w * s, c + v * v * d, v * w * d - u * s,
    u * w * d - v * s, v * w * d + u * s, c + w * w * d];
}

function times(a, b) {
  const out = new Array(9).fill(0);
  for (let i = 0; i < 3; i++) for (let j = 0; j < 3; j++) for (let k = 0; k < 3; k++) out[3 * i + j] += a[3 * i + k] * b[3 * k + j];
  return out;
}

function turned(m, p) {
  return [0, 1, 2].map((i) => m[3 * i] * p[0] + m[3 * i + 1] * p[1] + m[3 * i + 2] * p[2]);
}

// [12 × 24] rows that take points at rest to the posed world: SMPL's kinematic chain. `rotations` [24][9], local;
// `beyond` [288] or null: what the method adds, M - 1 and s of each joint, which first takes x to J + M (x - J) + s.
function chain(rotations, joints, parents, transl, beyond) {
  const world = [];
  const out = new Float32Array(12 * JOINTS);
  for (let j = 0; j < JOINTS; j++) {
    const parent = parents[j];
    const R = parent < 0 ? rotations[j] : times(world[parent].R, rotations[j]);
    const step = parent < 0 ? joints[j] : turned(world[parent].R, joints[j].map((v, k) => v - joints[parent][k]));
    const t = parent < 0 ? step : step.map((v, k) => v + world[parent].t[k]);
    world.push({ R, t });
    const own = beyond && [0, 1, 2].map((i) => [...beyond.subarray(12 * j + 4 * i, 12 * j + 4 * i + 4)]);
    const L = own ? times(R, own.flatMap((row, i) => [0, 1, 2].map((k) => row[k] + Number(i === k)))) : R;
    const shift = own ? turned(R, own.map((row) => row[3])) : [0, 0, 0], moved = turned(L, joints[j]);
    for (let i = 0; i < 3; i++) {
      out.set([L[3 * i], L[3 * i + 1], L[3 * i + 2], t[i] + shift[i] - moved[i] + transl[i]], 12 * j + 4 * i);
    }
  }
  return out;
}

// --- unpacking what `ihbench.reports.site.avatars` has packed ---

async function inflated(name) {
  const text = fileText(name);
  if (text === null) throw new Error(`${name} is not in this page`);
  const stream = new Blob([bytesOf(text)]).stream().pipeThrough(new DecompressionStream("deflate-raw"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// [9] of a unit quaternion without its w, which is not negative
function turnedBy(x, y, z) {
  const w = Math.sqrt(Math.max(0, 1 - x * x - y * y - z * z));
  return [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z), 1 - 2 * (x * x + z * z),
    2 * (y * z - w * x), 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)];
}

async function unpacked(about) {
  const [own, skin, moves] = await Promise.all([about.own, about.skin, about.corrected?.file].map((name) => name && inflated(name)));
  const n = about.count, above = (about.degree + 1) ** 2 - 1;
  const narrow = (data, at) => {
    const out = new Uint8Array(n);
    for (let i = 0, v = 0; i < n; i++) out[i] = v = (v + data[at + i]) & 255;
    return out;
  };
  const wide = (data, at, count = n) => {
    const out = new Uint16Array(count);
    for (let i = 0, v = 0; i < count; i++) out[i] = v = (v + data[at + i] + 256 * data[at + count + i]) & 65535;
    return out;
  };
  const together = (planes) => {
    const out = new Uint8Array(planes.length * n);
    planes.forEach((plane, k) => { for (let i = 0; i < n; i++) out[planes.length * i + k] = plane[i]; });
    return out;
  };
  const rest = new Float32Array(3 * n);
  for (let k = 0; k < 3; k++) {
    const plane = wide(own, 2 * n * k);
    for (let i = 0; i < n; i++) rest[3 * i + k] = about.low[k] + plane[i] / 65535 * about.size[k];
  }
  const [low, high] = about.scales.map(Math.log);
  let at = 6 * n; // where the next plane begins
  const wides = (count) => Array.from({ length: count }, () => { at += 2 * n; return wide(own, at - 2 * n); });
  const narrows = (count) => Array.from({ length: count }, () => { at += n; return narrow(own, at - n); });
  const length = (v) => Math.exp(low + v / 65535 * (high - low));
  let scales = null, shapes = null;
  if (about.general) {
    const sizes = wides(3), turns = wides(3), [opacities] = narrows(1);
    shapes = new Float32Array(8 * n);
    for (let i = 0; i < n; i++) {
      const R = turnedBy(...turns.map((plane) => 2 * plane[i] / 65535 - 1));
      const variances = sizes.map((plane) => length(plane[i]) ** 2);
      const entry = (r, c) => variances.reduce((sum, v, k) => sum + v * R[3 * r + k] * R[3 * c + k], 0);
      shapes.set([entry(0, 0), entry(0, 1), entry(0, 2), entry(1, 1), entry(1, 2), entry(2, 2), opacities[i] / 255, 0], 8 * i);
    }
  } else scales = Float32Array.from(wides(1)[0], length);
  const samples = moves ? moves.length / 2 / 12 / JOINTS : 0;
  return {
    count: n, rest, scales, shapes, colours: together(narrows(3)), labels: narrows(1)[0], harmonics: together(narrows(3 * above)),
    degree: about.degree, tone: [about.colours[0], about.colours[1] - about.colours[0], about.reach], turning: about.turning,
    // of each of 288 numbers all samples
    corrections: samples ? { ...about.corrected, samples, levels: new Int16Array(wide(moves, 0, moves.length / 2).buffer) } : null,
    bones: together([0, 1, 2, 3].map((k) => narrow(skin, k * n))), weights: together([4, 5, 6, 7].map((k) => narrow(skin, k * n))),
    joints: about.joints,
  };
}
