// Fetches a stream: chunk by chunk over one request, again from where the line broke, again what was damaged.
"use strict";
const Loader = (() => {
  const BREAKS = 5, DAMAGES = 3, PAUSE = 500, SILENCE = 20000;
  const wait = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

  // A refusal that no second try will change.
  class Refused extends Error {}

  async function ask(url, headers, fresh, abort) {
    const response = await fetch(url, { headers, cache: fresh ? "reload" : "no-cache", signal: abort.signal });
    if (response.ok) return response;
    const kind = response.status >= 500 || response.status === 408 || response.status === 429 ? Error : Refused;
    throw new kind(`${url}: ${response.status} ${response.statusText}`);
  }

  async function manifest(base) {
    for (let attempt = 0; ; attempt++) {
      try {
        const response = await ask(base + "manifest.json", {}, false, new AbortController());
        const text = await response.text();
        return { found: check(JSON.parse(text)), bytes: text.length };
      } catch (error) {
        if (error instanceof SyntaxError) throw new Refused("manifest.json is damaged; write the stream anew.");
        if (attempt >= BREAKS || error instanceof Refused) throw error;
        await wait(PAUSE * 2 ** attempt);
      }
    }
  }

  function check(found) {
    if (found.format !== "freqgs-stream" || found.version !== 2) {
      throw new Refused(
        `manifest.json is ${found.format} of version ${found.version}; this reads freqgs-stream 2. Write the stream anew.`);
    }
    // one list per field; steps and components that are all the same or all there are not listed
    const columns = Object.entries(found.chunks);
    const rows = found.chunks.offset.map((_, i) => Object.fromEntries(columns.map(([name, values]) => [name, values[i]])));
    const levels = found.levels.map((level) => ({ ...level, codings: level.codings.map(unfold) }));
    return { ...found, chunks: rows, levels };
  }

  function unfold(coding) {
    const all = Array.from({ length: coding.components }, (_, k) => k);
    return { ...coding, kept: coding.kept ?? all, step: all.map((k) => coding.step[k] ?? coding.step) };
  }

  // Calls arrived(entry, bytes) for each chunk that is right and received(count) for bytes; resolves to what is missing.
  async function chunks(base, found, missing, arrived, received, report) {
    const damages = new Map(), damaged = [];
    let breaks = 0;
    while (missing.length) {
      let last = 1;
      while (last < missing.length && missing[last] === missing[last - 1] + 1) last++;
      const run = missing.slice(0, last);
      const again = run.some((i) => damages.has(i));
      try {
        await readRun(base, found, run, again, received, async (index, bytes) => {
          const entry = found.chunks[index];
          missing.splice(missing.indexOf(index), 1);
          let right = Decode.checksum(bytes) === entry.crc32;
          if (right) right = await arrived(entry, bytes).then(() => true, () => false);
          if (right) {
            breaks = 0;
            report("");
            return;
          }
          const times = (damages.get(index) || 0) + 1;
          damages.set(index, times);
          // to the end: what follows it is drawn first
          (times >= DAMAGES ? damaged : missing).push(index);
        });
      } catch (error) {
        if (error instanceof Refused || ++breaks > BREAKS) {
          report(`The line broke: ${error.message}. What has arrived stays.`);
          return { missing: missing.concat(damaged), broken: true };
        }
        report(`The line broke; asking again (${breaks} of ${BREAKS}).`);
        await wait(PAUSE * 2 ** (breaks - 1));
      }
    }
    return { missing: damaged, broken: false };
  }

  async function readRun(base, found, run, again, received, give) {
    const start = found.chunks[run[0]].offset, final = found.chunks[run[run.length - 1]];
    const abort = new AbortController();
    let silence = setTimeout(() => abort.abort(), SILENCE);
    try {
      const range = `bytes=${start}-${final.offset + final.bytes - 1}`;
      const response = await ask(base + found.data, { Range: range }, again, abort);
      // a server that ignores ranges begins at the beginning
      let skip = response.status === 206 ? 0 : start;
      const reader = response.body.getReader();
      const pending = [];
      let have = 0;
      for (const index of run) {
        const need = found.chunks[index].bytes;
        while (have < need) {
          const { done, value } = await reader.read();
          clearTimeout(silence);
          silence = setTimeout(() => abort.abort(), SILENCE);
          if (done) throw new Error("it ended early");
          received(value.length);
          const block = skip > 0 ? value.subarray(Math.min(skip, value.length)) : value;
          skip -= value.length - block.length;
          pending.push(block);
          have += block.length;
        }
        const bytes = new Uint8Array(need);
        let at = 0;
        while (at < need) {
          const block = pending.shift(), part = block.subarray(0, need - at);
          bytes.set(part, at);
          at += part.length;
          if (part.length < block.length) pending.unshift(block.subarray(part.length));
        }
        have -= need;
        await give(index, bytes);
      }
      abort.abort();
    } finally {
      clearTimeout(silence);
    }
  }

  // A stream inside of the page itself: base64 in two script elements.
  function embedded() {
    const found = check(JSON.parse(document.getElementById("manifest").textContent));
    const text = atob(document.getElementById("splats").textContent.trim());
    const data = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) data[i] = text.charCodeAt(i);
    return { found, data, bytes: 0 };
  }

  return { manifest, chunks, embedded };
})();
