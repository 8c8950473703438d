// A worker: which rows are drawn, and in which order, front to back.
"use strict";
let means, opacities, decays, levels, sceneDistance, depths, keys, other, rows, otherRows;

onmessage = ({ data }) => {
  if (data.kind === "begin") {
    const n = data.count;
    sceneDistance = data.sceneDistance;
    means = new Float32Array(3 * n);
    opacities = new Float32Array(n);
    decays = new Float32Array(n);
    levels = new Uint8Array(n);
    depths = new Float32Array(n);
    [keys, other, rows, otherRows] = [0, 1, 2, 3].map(() => new Uint32Array(n));
  } else if (data.kind === "rows") {
    means.set(data.means, 3 * data.first);
    opacities.set(data.opacities, data.first);
    if (data.decay) decays.set(data.decay, data.first);
    levels.fill(data.level, data.first, data.first + data.opacities.length);
  } else if (data.kind === "sort") {
    const start = performance.now();
    const { order, drawn } = sorted(data);
    postMessage({ id: data.id, order, drawn, milliseconds: performance.now() - start }, [order.buffer]);
  }
};

function sorted({ forward, eye, level, scale, budget }) {
  const [fx, fy, fz] = forward, [ex, ey, ez] = eye;
  const whole = Math.floor(level), highest = level > whole ? whole + 1 : whole;
  const end = Math.min(budget, levels.length);
  let count = 0, drawn = 0;
  for (let i = 0; i < end; i++) {
    if (levels[i] === 0 || levels[i] > highest) continue;
    const x = means[3 * i] - ex, y = means[3 * i + 1] - ey, z = means[3 * i + 2] - ez;
    if (sceneDistance > 0 && !shown(Math.hypot(x, y, z), opacities[i], decays[i], scale)) continue;
    drawn++;
    const depth = fx * x + fy * y + fz * z;
    if (depth <= 0.01) continue;
    depths[count] = depth;
    rows[count++] = i;
  }
  return { order: radix(count), drawn };
}

// Whether functional/attenuation.py gives a weight above 0.
function shown(distance, opacity, sigma, scale) {
  const s = Math.max(sigma, 0);
  const far = Math.min((distance / sceneDistance) * scale / Math.sqrt(2 * s * s + 1e-8), 100);
  return Math.log(Math.max(opacity, 1e-30)) - far * far > Math.log(scale / 255);
}

// By the bits of positive floats, which are ordered as they are; equal depths stay in the order of rows.
function radix(count) {
  const bits = new Uint32Array(depths.buffer);
  for (let i = 0; i < count; i++) keys[i] = bits[i];
  let [from, to, fromRows, toRows] = [keys, other, rows, otherRows];
  for (const shift of [0, 16]) {
    const starts = new Uint32Array(65537);
    for (let i = 0; i < count; i++) starts[((from[i] >>> shift) & 65535) + 1]++;
    for (let k = 0; k < 65536; k++) starts[k + 1] += starts[k];
    for (let i = 0; i < count; i++) {
      const at = starts[(from[i] >>> shift) & 65535]++;
      to[at] = from[i];
      toRows[at] = fromRows[i];
    }
    [from, to, fromRows, toRows] = [to, from, toRows, fromRows];
  }
  return fromRows.slice(0, count);
}
