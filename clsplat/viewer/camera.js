// Cameras: x right, y down, z forward.  A camera is {rotation: [9], eye: [3], lens: [6]}: the row-major rotation from
// world to camera, the camera center, and lens = [fx, fy, cx, cy, width, height] of its image, px.

const add = (a, b, f = 1) => a.map((v, i) => v + f * b[i]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const scaled = (a, f) => a.map(v => v * f);
const size = a => Math.hypot(...a);
const normalized = a => scaled(a, 1 / (size(a) || 1));
const mix = (a, b, t) => a.map((v, i) => v + (b[i] - v) * t);
const axis = (camera, i) => camera.rotation.slice(3 * i, 3 * i + 3); // right, down, forward in the world

const cameraOf = ({pose, lens}) => {
  const rotation = [0, 1, 2].flatMap(i => pose.slice(4 * i, 4 * i + 3)), shift = [pose[3], pose[7], pose[11]];
  const eye = [0, 1, 2].map(k => -(rotation[k] * shift[0] + rotation[3 + k] * shift[1] + rotation[6 + k] * shift[2]));
  return {rotation, eye, lens: [...lens]};
};

function quaternion(r) { // x, y, z, w of a row-major rotation
  const q = [r[0] - r[4] - r[8], r[4] - r[0] - r[8], r[8] - r[0] - r[4], r[0] + r[4] + r[8]];
  const k = q.indexOf(Math.max(...q)), s = Math.sqrt(1 + q[k]) * 2, out = [0, 0, 0, 0];
  const [yz, zx, xy] = [[r[7], r[5]], [r[2], r[6]], [r[3], r[1]]];
  out[k] = s / 4;
  const both = [[xy, 0, 1], [zx, 0, 2], [yz, 1, 2]], single = [[yz, 0], [zx, 1], [xy, 2]];
  if (k === 3) single.forEach(([[a, b], i]) => { out[i] = (a - b) / s; });
  else {
    both.forEach(([[a, b], i, j]) => { if (i === k || j === k) out[i === k ? j : i] = (a + b) / s; });
    const [[a, b]] = single[k];
    out[3] = (a - b) / s;
  }
  return out;
}

function rotationOf([x, y, z, w]) {
  return [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)];
}

function interpolateCameras(a, b, t) { // t: 0 returns a, 1 returns b
  if (t >= 1) return b;
  let p = quaternion(a.rotation), q = quaternion(b.rotation);
  let cosine = p.reduce((sum, v, i) => sum + v * q[i], 0);
  if (cosine < 0) [q, cosine] = [scaled(q, -1), -cosine];
  const angle = Math.acos(Math.min(1, cosine)), sine = Math.sin(angle);
  const [f, g] = sine < 1e-6 ? [1 - t, t] : [Math.sin((1 - t) * angle) / sine, Math.sin(t * angle) / sine];
  const rotated = p.map((v, i) => f * v + g * q[i]);
  const rotation = rotationOf(scaled(rotated, 1 / size(rotated)));
  return {rotation, eye: mix(a.eye, b.eye, t), lens: mix(a.lens, b.lens, t)};
}

// Rotate a camera by an angle about an axis of the world through a point.
function rotated(camera, about, angle, center) {
  const c = Math.cos(angle), s = Math.sin(angle);
  const turn = v => add(add(scaled(v, c), cross(about, v), s), about, dot(about, v) * (1 - c));
  return {...camera, eye: add(center, turn(add(camera.eye, center, -1))),
    rotation: [0, 1, 2].flatMap(i => turn(axis(camera, i)))};
}

// Remove the roll of a camera.
function withoutRoll(camera, up) {
  const forward = axis(camera, 2), right = cross(forward, up);
  if (size(right) < 1e-3) return camera;
  const across = normalized(right);
  return {...camera, rotation: [...across, ...cross(forward, across), ...forward]};
}

// The area of a canvas of width x height px that the camera's image fills: scale, left and top.
function fitToCanvas(lens, width, height) {
  const enlarged = Math.min(width / lens[4], height / lens[5]);
  return {enlarged, left: (width - enlarged * lens[4]) / 2, top: (height - enlarged * lens[5]) / 2};
}

// The uniforms of the shaders for a camera and a canvas.  exact: clamp rays outside the camera's image, as
// `clsplat render` does; otherwise clamp rays outside the canvas, which shows more than that image.  native: the focal
// length, px, at which the scale `enlarged` is 1.
function makeFrame(camera, width, height, exact, native = 1) {
  const [fx, fy, cx, cy, w, h] = camera.lens, {enlarged, left, top} = fitToCanvas(camera.lens, width, height);
  const intrinsics = [fx * enlarged, fy * enlarged, cx * enlarged + left, cy * enlarged + top];
  const [x, y, u, v, across, down] = exact ? camera.lens : [...intrinsics, width, height];
  const margin = [0.3 * across / (2 * x), 0.3 * down / (2 * y)];
  return {
    width, height, eye: camera.eye, rotation: camera.rotation, intrinsics, enlarged: enlarged * fx / native,
    translation: [0, 1, 2].map(i => -dot(axis(camera, i), camera.eye)),
    limits: [-u / x - margin[0], (across - u) / x + margin[0], -v / y - margin[1], (down - v) / y + margin[1]],
  };
}

const formatCamera = camera => [camera.eye, quaternion(camera.rotation), camera.lens]
  .map(part => part.map(v => +v.toPrecision(8)).join(",")).join(";");

// Read the camera, and the timestamp if there is one, from the fragment (#) of a URL; null if it has no camera.
function parseCamera(text) {
  const parts = text.replace(/^#/, "").split(";").map(part => part.split(",").map(Number));
  if (![3, 4].includes(parts.length) || parts.some((part, i) => part.length !== [3, 4, 6, 1][i])) return null;
  if (!parts.flat().every(Number.isFinite)) return null;
  const [eye, turn, lens, [timestamp] = []] = parts;
  if (size(turn) < 1e-6 || [lens[0], lens[1], lens[4], lens[5]].some(v => v <= 0)) return null;
  return {eye, rotation: rotationOf(scaled(turn, 1 / size(turn))), lens, timestamp};
}
