// Where one looks from: orbit and fly, by mouse, fingers and keys. Axes are OpenCV's: x right, y down, z forward.
"use strict";
const add = (a, b, s = 1) => a.map((x, i) => x + s * b[i]);
const dot = (a, b) => a.reduce((sum, x, i) => sum + x * b[i], 0);
const unit = (a) => a.map((x) => x / (Math.hypot(...a) || 1));
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

function turned(v, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle), w = cross(axis, v), d = dot(axis, v) * (1 - c);
  return v.map((x, i) => x * c + w[i] * s + axis[i] * d);
}

class Eye {
  constructor(canvas, changed) {
    this.canvas = canvas;
    this.changed = changed;
    this.right = [1, 0, 0];
    this.down = [0, 1, 0];
    this.forward = [0, 0, 1];
    this.eye = [0, 0, -3];
    this.up = [0, -1, 0];
    this.distance = 3;
    this.fly = false;
    this.lens = null;
    this.pointers = new Map();
    this.keys = new Set();
    this.listen();
  }

  // Take the place of a view of the manifest.
  take(view, distance) {
    const m = view.viewmat;
    [this.right, this.down, this.forward] = [0, 1, 2].map((r) => unit(m.slice(4 * r, 4 * r + 3)));
    this.eye = eyeOf(m);
    this.lens = view;
    if (distance) this.distance = distance;
    this.changed();
  }

  camera(width, height) {
    const rows = [this.right, this.down, this.forward];
    const view = rows.flatMap((row) => [...row, -dot(row, this.eye)]).concat([0, 0, 0, 1]);
    const found = { view, eye: this.eye, forward: this.forward, width, height };
    if (!this.lens) {
      const f = 0.9 * Math.min(width, height);
      return { ...found, fx: f, fy: f, cx: width / 2, cy: height / 2 };
    }
    // the whole of the view's picture is shown, and more where the window has another shape
    const { K, width: w, height: h } = this.lens, s = Math.min(width / w, height / h);
    const [cx, cy] = [width / 2 + s * (K[2] - w / 2), height / 2 + s * (K[5] - h / 2)];
    return { ...found, fx: s * K[0], fy: s * K[4], cx, cy };
  }

  rotate(dx, dy) {
    const target = add(this.eye, this.forward, this.distance), sign = this.fly ? -1 : 1;
    for (const [axis, angle] of [[this.up, -sign * dx], [this.right, sign * dy]]) {
      const next = turned(this.forward, axis, angle);
      // not over the pole
      if (axis === this.right && Math.abs(dot(next, this.up)) > 0.995) continue;
      this.forward = unit(next);
      this.right = unit(cross(this.forward, this.up));
      this.down = cross(this.forward, this.right);
    }
    if (!this.fly) this.eye = add(target, this.forward, -this.distance);
    this.changed();
  }

  move(x, y, z) {
    this.eye = add(add(add(this.eye, this.right, x), this.down, y), this.forward, z);
    this.changed();
  }

  zoom(factor) {
    if (this.fly) return this.move(0, 0, this.distance * (1 - factor));
    const before = this.distance;
    this.distance = Math.max(before * factor, 1e-4);
    this.move(0, 0, before - this.distance);
  }

  listen() {
    const { canvas, pointers } = this;
    canvas.addEventListener("pointerdown", (e) => {
      canvas.setPointerCapture(e.pointerId);
      pointers.set(e.pointerId, [e.clientX, e.clientY]);
      canvas.focus();
    });
    for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (e) => pointers.delete(e.pointerId));
    canvas.addEventListener("pointermove", (e) => {
      const before = pointers.get(e.pointerId);
      if (!before) return;
      const now = [e.clientX, e.clientY], dx = now[0] - before[0], dy = now[1] - before[1];
      const other = [...pointers].find(([id]) => id !== e.pointerId);
      pointers.set(e.pointerId, now);
      const pixel = this.distance / Math.min(canvas.clientWidth, canvas.clientHeight);
      if (other) {
        const length = (p) => Math.hypot(p[0] - other[1][0], p[1] - other[1][1]) || 1;
        this.zoom(length(before) / length(now));
        this.move(-0.5 * dx * pixel, -0.5 * dy * pixel, 0);
      } else if (e.buttons & 2 || e.shiftKey) this.move(-dx * pixel, -dy * pixel, 0);
      else this.rotate(dx * 0.006, -dy * 0.006);
    });
    canvas.addEventListener("contextmenu", (e) => e.preventDefault());
    canvas.addEventListener("wheel", (e) => {
      e.preventDefault();
      this.zoom(Math.exp(Math.max(-1, Math.min(1, e.deltaY * 0.002))));
    }, { passive: false });
    canvas.addEventListener("keydown", (e) => {
      if (MOVES[e.code]) {
        this.keys.add(e.code);
        this.changed();
        e.preventDefault();
      }
    });
    canvas.addEventListener("keyup", (e) => this.keys.delete(e.code));
    canvas.addEventListener("blur", () => this.keys.clear());
  }

  // Keys that are held, for so many seconds. Whether any is.
  step(seconds) {
    for (const key of this.keys) this.move(...MOVES[key].map((x) => x * this.distance * 0.6 * seconds));
    return this.keys.size > 0;
  }
}

const MOVES = {
  KeyW: [0, 0, 1], KeyS: [0, 0, -1], KeyA: [-1, 0, 0], KeyD: [1, 0, 0], KeyQ: [0, 1, 0], KeyE: [0, -1, 0],
  ArrowUp: [0, 0, 1], ArrowDown: [0, 0, -1], ArrowLeft: [-1, 0, 0], ArrowRight: [1, 0, 0],
};

function eyeOf(m) {
  return [0, 1, 2].map((k) => -(m[k] * m[3] + m[4 + k] * m[7] + m[8 + k] * m[11]));
}
