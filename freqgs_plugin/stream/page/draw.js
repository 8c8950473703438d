// Textures of the rows, and pictures of them.
"use strict";
const WIDTH = 1024;

class Painter {
  constructor(canvas, manifest) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("This browser has no WebGL2.");
    // colours of residuals are negative, so sums need floats
    if (!gl.getExtension("EXT_color_buffer_float") && !gl.getExtension("EXT_color_buffer_half_float")) {
      throw new Error("This device cannot draw into float pictures, which signed colours need.");
    }
    this.gl = gl;
    this.manifest = manifest;
    this.degree = manifest.colour.sh_degree;
    this.rows = Math.max(1, Math.ceil(manifest.count / WIDTH));
    if (this.rows > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error("The scene has too many splats for this device.");
    this.layers = Math.ceil((3 * (this.degree + 1) ** 2) / 4);
    this.head = new Float32Array(4 * manifest.count);
    this.means = this.texture(gl.RGBA32F);
    this.scales = this.texture(gl.RGBA32F);
    this.quats = this.texture(gl.RGBA32F);
    this.decays = this.texture(gl.R32F);
    this.harmonics = this.texture(gl.RGBA16F, this.layers);
    this.prepared = [0, 1, 2].map(() => this.texture(gl.RGBA32UI));
    this.preparedBuffer = this.framebuffer(this.prepared);
    this.prepare = this.program(Shaders.PREPARE_VERTEX, Shaders.PREPARE(this.degree));
    this.splat = this.program(Shaders.SPLAT_VERTEX, Shaders.SPLAT);
    this.show = this.program(Shaders.PREPARE_VERTEX, Shaders.SHOW);
    this.nothing = gl.createVertexArray();
    this.instances = gl.createVertexArray();
    this.orderBuffer = gl.createBuffer();
    gl.bindVertexArray(this.instances);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.orderBuffer);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(0, 1);
    this.count = 0;
    this.enlarge = 1;
    this.sum = null;
  }

  texture(format, layers = 0) {
    const gl = this.gl, kind = layers ? gl.TEXTURE_2D_ARRAY : gl.TEXTURE_2D, texture = gl.createTexture();
    gl.bindTexture(kind, texture);
    if (layers) gl.texStorage3D(kind, 1, format, WIDTH, this.rows, layers);
    else gl.texStorage2D(kind, 1, format, WIDTH, this.rows);
    this.nearest(kind);
    return texture;
  }

  nearest(kind) {
    const gl = this.gl;
    gl.texParameteri(kind, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(kind, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    gl.texParameteri(kind, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(kind, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  }

  framebuffer(textures) {
    const gl = this.gl, buffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    const places = textures.map((texture, i) => {
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, gl.TEXTURE_2D, texture, 0);
      return gl.COLOR_ATTACHMENT0 + i;
    });
    gl.drawBuffers(places);
    const status = gl.checkFramebufferStatus(gl.FRAMEBUFFER);
    if (status !== gl.FRAMEBUFFER_COMPLETE) throw new Error(`This device cannot draw into such a picture (${status}).`);
    return buffer;
  }

  program(vertex, fragment) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    const places = {};
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
      const { name } = gl.getActiveUniform(program, i);
      places[name] = gl.getUniformLocation(program, name);
    }
    return { program, places };
  }

  // Rows of a chunk.
  add(entry, columns) {
    const { first, count } = entry, gl = this.gl;
    if (entry.part === "core") {
      const means = new Float32Array(4 * count), scales = new Float32Array(4 * count);
      for (let i = 0; i < count; i++) {
        for (let k = 0; k < 3; k++) {
          means[4 * i + k] = columns.means[3 * i + k];
          scales[4 * i + k] = columns.scales[3 * i + k];
          this.head[4 * (first + i) + k] = columns.features_dc[3 * i + k];
        }
        means[4 * i + 3] = columns.opacities[i];
        scales[4 * i + 3] = entry.level;
      }
      this.upload(this.means, gl.RGBA, 4, first, count, means);
      this.upload(this.scales, gl.RGBA, 4, first, count, scales);
      this.upload(this.quats, gl.RGBA, 4, first, count, columns.quats);
      if (columns.decay) this.upload(this.decays, gl.RED, 1, first, count, columns.decay);
    } else {
      const rest = columns.features_rest, width = rest.length / count;
      for (let i = 0; i < count; i++) this.head[4 * (first + i) + 3] = rest[width * i];
      for (let layer = 1; layer < this.layers; layer++) {
        const part = new Float32Array(4 * count), from = 4 * layer - 3;
        for (let i = 0; i < count; i++) {
          for (let k = 0; k < 4 && from + k < width; k++) part[4 * i + k] = rest[width * i + from + k];
        }
        this.upload(this.harmonics, gl.RGBA, 4, first, count, part, layer);
      }
    }
    this.upload(this.harmonics, gl.RGBA, 4, first, count, this.head.subarray(4 * first, 4 * (first + count)), 0);
  }

  // A range of rows is up to three rectangles.
  upload(texture, format, width, first, count, data, layer = -1) {
    const gl = this.gl, kind = layer < 0 ? gl.TEXTURE_2D : gl.TEXTURE_2D_ARRAY, end = first + count;
    gl.bindTexture(kind, texture);
    for (let row = first; row < end; ) {
      const x = row % WIDTH, y = (row - x) / WIDTH;
      const full = x === 0 ? Math.floor((end - row) / WIDTH) : 0;
      const [w, h] = full > 0 ? [WIDTH, full] : [Math.min(WIDTH - x, end - row), 1];
      const part = data.subarray(width * (row - first), width * (row - first + w * h));
      if (layer < 0) gl.texSubImage2D(kind, 0, x, y, w, h, format, gl.FLOAT, part);
      else gl.texSubImage3D(kind, 0, x, y, layer, w, h, 1, format, gl.FLOAT, part);
      row += w * h;
    }
  }

  // The order from front to back.
  order(rows) {
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.orderBuffer);
    gl.bufferData(gl.ARRAY_BUFFER, rows, gl.DYNAMIC_DRAW);
    this.count = rows.length;
  }

  // camera: view (16, by rows), eye, fx, fy, cx, cy, width, height; look: level, scale. Into `target`, null: the canvas.
  draw(camera, look, target = null) {
    const gl = this.gl, { width, height } = camera;
    this.resize(width, height);
    gl.disable(gl.BLEND);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.preparedBuffer);
    gl.viewport(0, 0, WIDTH, this.rows);
    const { program, places } = this.prepare, m = this.manifest;
    gl.useProgram(program);
    this.bind(places, { means: this.means, scales: this.scales, quats: this.quats, decays: this.decays });
    gl.activeTexture(gl.TEXTURE4);
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, this.harmonics);
    gl.uniform1i(places.harmonics, 4);
    gl.uniformMatrix4fv(places.view, true, camera.view);
    gl.uniform3fv(places.eye, camera.eye);
    gl.uniform4f(places.intrinsics, camera.fx, camera.fy, camera.cx, camera.cy);
    gl.uniform2f(places.size, width, height);
    gl.uniform1f(places.level, look.level);
    gl.uniform1f(places.enlarge, this.enlarge);
    gl.uniform1f(places.distance_scale, look.scale);
    gl.uniform1f(places.scene_distance, m.decay ? m.decay.scene_distance : 0);
    gl.uniform1f(places.antialiased, m.render.antialiased ? 1 : 0);
    gl.uniform1f(places.signed_residuals, m.colour.signed_residuals ? 1 : 0);
    gl.bindVertexArray(this.nothing);
    gl.drawArrays(gl.TRIANGLES, 0, 3);

    gl.bindFramebuffer(gl.FRAMEBUFFER, this.sum.buffer);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(this.splat.program);
    const [place, extent, colour] = this.prepared;
    this.bind(this.splat.places, { place, extent, colour });
    gl.uniform2f(this.splat.places.size, width, height);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE_MINUS_DST_ALPHA, gl.ONE);
    gl.bindVertexArray(this.instances);
    if (this.count) gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.count);

    gl.disable(gl.BLEND);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.useProgram(this.show.program);
    this.bind(this.show.places, { picture: this.sum.texture });
    gl.uniform3fv(this.show.places.background, m.render.background);
    gl.bindVertexArray(this.nothing);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  bind(places, textures) {
    const gl = this.gl;
    Object.entries(textures).forEach(([name, texture], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(places[name], unit);
    });
    gl.activeTexture(gl.TEXTURE7);
  }

  resize(width, height) {
    const gl = this.gl;
    if (this.sum && this.sum.width === width && this.sum.height === height) return;
    if (this.sum) {
      gl.deleteTexture(this.sum.texture);
      gl.deleteFramebuffer(this.sum.buffer);
    }
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA16F, width, height);
    this.nearest(gl.TEXTURE_2D);
    this.sum = { width, height, texture, buffer: this.framebuffer([texture]) };
  }

  // RGBA bytes of a picture, the upper row last.
  capture(camera, look) {
    const gl = this.gl, { width, height } = camera, texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA8, width, height);
    this.nearest(gl.TEXTURE_2D);
    const buffer = this.framebuffer([texture]);
    this.draw(camera, look, buffer);
    const out = new Uint8Array(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, out);
    gl.deleteFramebuffer(buffer);
    gl.deleteTexture(texture);
    return out;
  }
}
