// Chunks of a stream to numbers: what `stream/quantise.py` writes.
"use strict";
const Decode = (() => {
  const table = new Uint32Array(256);
  for (let n = 0; n < 256; n++) {
    let c = n;
    for (let k = 0; k < 8; k++) c = c & 1 ? 0xedb88320 ^ (c >>> 1) : c >>> 1;
    table[n] = c;
  }

  function checksum(bytes) {
    let c = 0xffffffff;
    for (let i = 0; i < bytes.length; i++) c = table[(c ^ bytes[i]) & 255] ^ (c >>> 8);
    return (c ^ 0xffffffff) >>> 0;
  }

  async function inflate(bytes) {
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  }

  const OTHERS = [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]];

  // One column as rows x components floats.
  function column(coding, data, start, rows) {
    const { components, size, kept, low, step, warp } = coding;
    const out = new Float32Array(rows * components);
    const word = new Uint32Array(1), float = new Float32Array(word.buffer);
    const slot = new Int32Array(components).fill(-1);
    kept.forEach((component, k) => { slot[component] = k; });
    for (let c = 0; c < components; c++) {
      if (slot[c] < 0) {
        for (let i = 0; i < rows; i++) out[i * components + c] = size === 4 ? low[c] : value(coding, c, 0);
        continue;
      }
      const plane = start + slot[c] * size * rows;
      for (let i = 0; i < rows; i++) {
        let q = 0;
        for (let b = 0; b < size; b++) q = q * 256 + data[plane + b * rows + i];
        if (size === 4) {
          word[0] = q;
          out[i * components + c] = float[0];
        } else out[i * components + c] = value(coding, c, q);
      }
    }
    if (size !== 4 && warp === "smallest_three") for (let i = 0; i < rows; i++) quaternion(out, 4 * i);
    return out;
  }

  function value(coding, c, q) {
    const v = coding.low[c] + q * coding.step[c];
    switch (coding.warp) {
      case "exp": return Math.exp(v);
      case "sigmoid": return 1 / (1 + Math.exp(-v));
      case "sinh": return coding.centre[c] + coding.scale * Math.sinh(v);
      default: return v;
    }
  }

  function quaternion(out, at) {
    const a = out[at], b = out[at + 1], c = out[at + 2], largest = Math.round(out[at + 3]);
    const others = OTHERS[largest];
    out[at + others[0]] = a;
    out[at + others[1]] = b;
    out[at + others[2]] = c;
    out[at + largest] = Math.sqrt(Math.max(0, 1 - a * a - b * b - c * c));
  }

  // Columns of a chunk, by name.
  async function chunk(manifest, entry, bytes) {
    const codings = manifest.levels.find((l) => l.level === entry.level).codings.filter((c) => c.part === entry.part);
    const data = await inflate(bytes);
    const expected = codings.reduce((sum, c) => sum + c.size * c.kept.length * entry.count, 0);
    if (data.length !== expected) throw new Error(`a chunk holds ${data.length} bytes instead of ${expected}`);
    const found = {};
    let start = 0;
    for (const coding of codings) {
      found[coding.name] = column(coding, data, start, entry.count);
      start += coding.size * coding.kept.length * entry.count;
    }
    return found;
  }

  return { checksum, chunk };
})();
