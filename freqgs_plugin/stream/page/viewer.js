// The page: loads a stream, shows what has arrived, and what the controls ask for.
"use strict";
const $ = (id) => document.getElementById(id);
const BASE = new URL(new URLSearchParams(location.search).get("stream") || ".", location.href);
const LARGEST_SCALE = 32;

class Viewer {
  constructor() {
    this.look = { level: 1, scale: 1, budget: Infinity };
    this.received = { bytes: 0, rows: 0, chunks: 0, enlarge: Infinity };
    this.drawn = 0;
    this.sorts = { asked: 0, done: 0, milliseconds: 0 };
    this.waiting = new Map();
    this.view = 0;
    this.dirty = false;
    this.problem = "";
    this.done = false;
  }

  async start() {
    if (!("DecompressionStream" in window)) throw new Error("This browser is too old: it cannot inflate streams.");
    const inside = $("manifest");
    if (!inside && BASE.origin !== location.origin) throw new Error("Streams are loaded from the page's own server alone.");
    const { found, data, bytes } = inside ? Loader.embedded() : await Loader.manifest(folder());
    this.manifest = found;
    this.received.bytes = bytes;
    this.painter = new Painter($("canvas"), found);
    this.worker = new Worker(workerUrl());
    this.worker.onmessage = ({ data: reply }) => this.sorted(reply);
    this.worker.onerror = (e) => this.report(`The sorting worker failed: ${e.message}`);
    const sceneDistance = found.decay ? found.decay.scene_distance : 0;
    this.worker.postMessage({ kind: "begin", count: found.count, sceneDistance });
    this.eye = new Eye($("canvas"), () => this.touch());
    this.controls();
    this.place();
    this.missing = found.chunks.map((_, i) => i);
    requestAnimationFrame((t) => this.frame(t));
    if (inside) {
      for (const entry of found.chunks) {
        const bytes = data.subarray(entry.offset, entry.offset + entry.bytes);
        this.received.bytes += entry.bytes;
        if (Decode.checksum(bytes) !== entry.crc32) throw new Error("This file is damaged; copy or export it again.");
        await this.arrived(entry, bytes);
      }
      this.finish({ missing: [], broken: false });
    } else await this.load();
  }

  async load() {
    $("again").hidden = true;
    this.done = false;
    const counted = (n) => {
      this.received.bytes += n;
      this.progress();
    };
    const result = await Loader.chunks(
      folder(), this.manifest, this.missing.slice(), (e, b) => this.arrived(e, b), counted, (text) => this.report(text));
    this.missing = result.missing;
    this.finish(result);
  }

  finish({ missing, broken }) {
    this.done = true;
    $("again").hidden = missing.length === 0;
    if (missing.length && !broken) {
      this.report(`${missing.length} of ${this.manifest.chunks.length} parts arrived damaged; the rest is shown.`);
    }
    this.progress();
    this.touch();
  }

  async arrived(entry, bytes) {
    const columns = await Decode.chunk(this.manifest, entry, bytes);
    this.painter.add(entry, columns);
    this.received.chunks++;
    // closes the holes of what is missing
    this.received.enlarge = this.painter.enlarge = Math.min(this.received.enlarge, entry.enlarge);
    if (entry.part === "core") {
      if (!this.received.rows) this.measure(columns.means);
      this.received.rows += entry.count;
      const { means, opacities, decay } = columns;
      this.worker.postMessage({ kind: "rows", first: entry.first, level: entry.level, means, opacities, decay });
    }
    this.progress();
    this.touch();
  }

  // How far away the scene is, for the controls, from the first rows.
  measure(means) {
    const n = means.length / 3, middle = (values) => values.sort((a, b) => a - b)[values.length >> 1];
    const axis = (k) => middle(Array.from({ length: n }, (_, i) => means[3 * i + k]));
    this.centre = [axis(0), axis(1), axis(2)];
    if (this.manifest.views.length) this.eye.distance = Math.max(dot(add(this.centre, this.eye.eye, -1), this.eye.forward), 0.1);
    else {
      const spread = middle(Array.from({ length: n }, (_, i) => Math.hypot(...add([...means.slice(3 * i, 3 * i + 3)], this.centre, -1))));
      this.eye.distance = 4 * (spread || 1);
      this.eye.eye = add(this.centre, this.eye.forward, -this.eye.distance);
    }
  }

  place() {
    const { views } = this.manifest;
    if (!views.length) return;
    // the mean of the pictures' upper edges
    this.eye.up = unit(views.reduce((sum, v) => add(sum, v.viewmat.slice(4, 7), -1), [0, 0, 0]));
    this.eye.take(views[0]);
    $("view").textContent = views[0].name;
  }

  next(step) {
    const { views } = this.manifest;
    this.view = (this.view + step + views.length) % views.length;
    const ahead = this.centre ? dot(add(this.centre, eyeOf(views[this.view].viewmat), -1), views[this.view].viewmat.slice(8, 11)) : 0;
    this.eye.take(views[this.view], Math.max(ahead, 0.1));
    $("view").textContent = views[this.view].name;
  }

  controls() {
    const { levels, decay, count, views } = this.manifest, top = levels[levels.length - 1].level;
    const level = $("level");
    [level.min, level.max, level.value] = [1, top, top];
    $("level-row").hidden = top === 1;
    $("level-row").style.display = top === 1 ? "none" : "";
    $("scale-row").style.display = decay ? "" : "none";
    $("previous").hidden = $("next").hidden = views.length < 2;
    const read = () => {
      this.look.level = Number(level.value);
      this.look.scale = LARGEST_SCALE ** Number($("scale").value);
      this.look.budget = Math.max(1, Math.round(count * Number($("budget").value) ** 2));
      $("level-value").textContent = this.look.level.toFixed(2);
      $("scale-value").textContent = this.look.scale.toFixed(2);
      $("budget-value").textContent = this.look.budget.toLocaleString("en");
      this.touch();
    };
    for (const id of ["level", "scale", "budget"]) $(id).addEventListener("input", read);
    $("previous").addEventListener("click", () => this.next(-1));
    $("next").addEventListener("click", () => this.next(1));
    $("mode").addEventListener("click", () => {
      this.eye.fly = !this.eye.fly;
      $("mode").textContent = this.eye.fly ? "Fly" : "Orbit";
    });
    $("fold").addEventListener("click", () => {
      const open = $("fold").getAttribute("aria-expanded") === "true";
      $("fold").setAttribute("aria-expanded", String(!open));
    });
    $("again").addEventListener("click", () => {
      this.report("");
      this.load();
    });
    $("canvas").addEventListener("webglcontextlost", () => this.report("The graphics card was reset; reload the page."));
    window.addEventListener("resize", () => this.touch());
    read();
  }

  touch() {
    this.dirty = true;
  }

  report(text) {
    this.problem = text;
    $("problem").hidden = !text;
    $("problem").textContent = text;
  }

  progress() {
    const { bytes, chunks } = this.received;
    $("filled").style.width = `${Math.min(100, (100 * bytes) / this.manifest.bytes)}%`;
    $("bar").className = chunks === this.manifest.chunks.length ? "done" : "";
    this.tell();
  }

  tell() {
    const { bytes, chunks } = this.received, all = this.manifest.count;
    const part = chunks < this.manifest.chunks.length ? `, ${Math.floor((100 * bytes) / this.manifest.bytes)} % received` : "";
    $("count").textContent = `${this.drawn.toLocaleString("en")} of ${all.toLocaleString("en")} splats${part}`;
    $("time").textContent = this.milliseconds ? `${this.milliseconds.toFixed(1)} ms per picture` : "";
  }

  // Ask the worker; resolves when its order is in place.
  sort(camera, look = this.look) {
    const id = ++this.sorts.asked;
    const { forward, eye } = camera;
    this.worker.postMessage({ kind: "sort", id, forward, eye, level: look.level, scale: look.scale, budget: Math.min(look.budget, 2 ** 31) });
    return new Promise((resolve) => this.waiting.set(id, resolve));
  }

  sorted({ id, order, drawn, milliseconds }) {
    this.painter.order(order);
    this.drawn = drawn;
    this.sorts.done = id;
    this.sorts.milliseconds = milliseconds;
    this.waiting.get(id)();
    this.waiting.delete(id);
    this.redraw = true;
  }

  frame(time) {
    const seconds = Math.min((time - (this.before ?? time)) / 1000, 0.1);
    this.before = time;
    this.eye.step(seconds);
    if (!this.held) {
      const camera = this.size();
      if (this.dirty && this.sorts.asked === this.sorts.done) {
        this.dirty = false;
        this.sort(camera);
        this.redraw = true;
      }
      if (this.redraw) {
        this.redraw = false;
        this.paint(camera);
      }
    }
    requestAnimationFrame((t) => this.frame(t));
  }

  size() {
    const canvas = $("canvas"), ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(canvas.clientWidth * ratio)), height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    if (canvas.width !== width || canvas.height !== height) {
      [canvas.width, canvas.height] = [width, height];
      this.redraw = true;
    }
    return this.eye.camera(width, height);
  }

  paint(camera) {
    const { gl } = this.painter, start = performance.now();
    this.painter.draw(camera, this.look);
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    const poll = () => {
      const status = gl.clientWaitSync(fence, 0, 0);
      if (status === gl.TIMEOUT_EXPIRED) return void setTimeout(poll, 1);
      gl.deleteSync(fence);
      this.milliseconds = performance.now() - start;
      this.tell();
    };
    poll();
  }

  // What the tests see: the picture of a view at its own size, RGBA rows from the lower edge up, and the count drawn.
  async capture(view, look) {
    const { K, width, height, viewmat } = view;
    const camera = {
      view: viewmat, eye: eyeOf(viewmat), forward: viewmat.slice(8, 11), width, height,
      fx: K[0], fy: K[4], cx: K[2], cy: K[5],
    };
    this.held = true;
    await this.sort(camera, look);
    const pixels = this.painter.capture(camera, look);
    const drawn = this.drawn;
    this.held = false;
    this.touch();
    return { pixels, drawn };
  }
}

function folder() {
  return BASE.href.replace(/[^/]*$/, "");
}

function workerUrl() {
  const inside = $("sort-source");
  if (!inside) return "sort.js";
  return URL.createObjectURL(new Blob([inside.textContent], { type: "text/javascript" }));
}

window.freqgs = new Viewer();
window.freqgs.start().catch((error) => {
  window.freqgs.report(error.message);
  $("count").textContent = "Nothing can be shown.";
});
