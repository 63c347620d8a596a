// Draw models with WebGL2: textures of a model, one instanced quad per splat, blended from back to front.

const QUAD = new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]);
const MODES = ["splats", "points", "ellipsoids", "opacity"];

function program(gl, vertex, fragment) {
  const handle = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(handle, shader);
    if (gl.getShaderParameter(shader, gl.COMPILE_STATUS) || gl.isContextLost()) continue;
    throw Error(gl.getShaderInfoLog(shader));
  }
  gl.bindAttribLocation(handle, 0, "corner");
  gl.bindAttribLocation(handle, 1, "id");
  gl.linkProgram(handle);
  if (!gl.getProgramParameter(handle, gl.LINK_STATUS) && !gl.isContextLost()) throw Error(gl.getProgramInfoLog(handle));
  const locations = {};
  return {handle, at: name => locations[name] ??= gl.getUniformLocation(handle, name)};
}

function texture(gl, format, width, height, kind, type, data, filter = gl.NEAREST) {
  const handle = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, handle);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, filter);
  for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
  gl.texImage2D(gl.TEXTURE_2D, 0, format, width, height, 0, kind, type, data);
  return handle;
}

const motionTexture = ({motions}) => motions ? {motions} : {};

class Painter {
  constructor(canvas) {
    const attributes = {antialias: false, alpha: false, powerPreference: "high-performance"};
    const gl = this.gl = canvas.getContext("webgl2", attributes);
    if (!gl) throw Error("this browser has no WebGL2; enable hardware acceleration, or use another browser");
    // Blending hundreds of layers in 8 bits loses 10 dB; with half floats, no loss is visible in an 8-bit image.
    this.half = !!(gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float"));
    this.maxSize = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    const limit = this.maxSize;
    if (limit < ROW) throw Error(`textures need ${ROW} px, but this device allows only ${limit}; use another device`);
    this.programs = {};
    this.programsFor(STATIC_MODEL);
    this.present = program(gl, COVER, PRESENT);
    this.empty = gl.createVertexArray();
    this.quad = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.quad);
    gl.bufferData(gl.ARRAY_BUFFER, QUAD, gl.STATIC_DRAW);
    this.target = {};
    gl.disable(gl.DEPTH_TEST);
  }

  // Return the shader programs for static or moving models, compiled on first use.
  programsFor(motion) {
    return this.programs[motion] ??= {colors: program(this.gl, COVER, colors(motion)),
      splats: program(this.gl, splatVertex(motion), SPLAT_FRAGMENT)};
  }

  // Create a texture with a framebuffer to draw into it.
  surface(width, height, filter) {
    const gl = this.gl, format = this.half ? gl.RGBA16F : gl.RGBA8, type = this.half ? gl.HALF_FLOAT : gl.UNSIGNED_BYTE;
    const surface = {width, height, texture: texture(gl, format, width, height, gl.RGBA, type, null, filter)};
    surface.frame = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, surface.frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, surface.texture, 0);
    return surface;
  }

  // Upload the textures of a model.  data: from `unpackModel`.
  layer(header, data) {
    const gl = this.gl, rows = rowsOf(data.count, 1), words = gl.RGBA_INTEGER;
    const wide = splatsInRow(data.texels) * data.texels, high = rowsOf(data.count, data.texels);
    const programs = this.programsFor(data.motion ? MOVING_MODEL : STATIC_MODEL);
    const layer = {header, count: data.count, texels: data.texels, drawn: 0, ...programs};
    if (data.motion) {
      const {rows, wide} = data.motion, across = splatsInRow(wide) * wide;
      layer.motions = texture(gl, gl.RGBA32F, across, rowsOf(data.count, wide), gl.RGBA, gl.FLOAT, rows);
      layer.wide = wide;
    }
    layer.tables = texture(gl, gl.R32F, 256, 4, gl.RED, gl.FLOAT, data.tables);
    layer.places = texture(gl, gl.RGBA32UI, ROW, rows, words, gl.UNSIGNED_INT, data.places);
    layer.sizes = texture(gl, gl.R32UI, ROW, rows, gl.RED_INTEGER, gl.UNSIGNED_INT, data.sizes);
    layer.codes = texture(gl, gl.RGBA32UI, wide, high, words, gl.UNSIGNED_INT, data.colors);
    layer.shown = this.surface(ROW, rows, gl.NEAREST);
    layer.ids = gl.createBuffer();
    layer.array = gl.createVertexArray();
    gl.bindVertexArray(layer.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.quad);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
    gl.bindBuffer(gl.ARRAY_BUFFER, layer.ids);
    gl.bufferData(gl.ARRAY_BUFFER, 4 * Math.max(1, data.count), gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(1);
    gl.vertexAttribIPointer(1, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(1, 1);
    return layer;
  }

  // Upload the drawing order: ids from back to front.
  reorder(layer, order) {
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, layer.ids);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, order);
    layer.drawn = order.length;
  }

  bind(used, textures) {
    const gl = this.gl;
    gl.useProgram(used.handle);
    Object.entries(textures).forEach(([name, texture], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(used.at(name), unit);
    });
  }

  // Set the uniforms of a program for the motion of a layer at a timestamp.
  move(used, layer, timestamp) {
    if (!layer.motions) return;
    const {bends, turns} = layer.header.motion;
    const numbers = {wide: layer.wide, bends, turns};
    for (const [name, number] of Object.entries(numbers)) this.gl.uniform1i(used.at(name), number);
    this.gl.uniform1f(used.at("timestamp"), timestamp);
  }

  // Compute the colors of the first splats, unless they were computed for this camera position and timestamp.
  shade(layer, eye, first, timestamp) {
    const key = [...eye, first, layer.motions ? timestamp : 0].join(), gl = this.gl, used = layer.colors;
    if (key === layer.key) return;
    layer.key = key;
    this.bind(used, {tables: layer.tables, places: layer.places, codes: layer.codes, ...motionTexture(layer)});
    this.move(used, layer, timestamp);
    gl.uniform3fv(used.at("eye"), eye);
    gl.uniform1i(used.at("degree"), layer.header.degree);
    gl.uniform1i(used.at("texels"), layer.texels);
    gl.uniform1i(used.at("count"), first);
    gl.bindFramebuffer(gl.FRAMEBUFFER, layer.shown.frame);
    gl.viewport(0, 0, ROW, rowsOf(first, 1));
    gl.disable(gl.BLEND);
    gl.bindVertexArray(this.empty);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // Blend a layer into a surface of the size of `frame`, which `makeFrame` of camera.js returns.
  blend(layer, frame, {mode = "splats", first = layer.count, dot = 1.5, timestamp = 0} = {}) {
    const gl = this.gl, used = layer.splats, {header} = layer, {width, height} = frame;
    this.shade(layer, frame.eye, first, timestamp);
    const target = this.sized(width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.frame);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    const shapes = {tables: layer.tables, places: layer.places, sizes: layer.sizes, colors: layer.shown.texture};
    this.bind(used, {...shapes, ...motionTexture(layer)});
    this.move(used, layer, timestamp);
    gl.uniformMatrix3fv(used.at("rotation"), true, frame.rotation);
    gl.uniform3fv(used.at("translation"), frame.translation);
    gl.uniform4fv(used.at("intrinsics"), frame.intrinsics);
    gl.uniform4fv(used.at("limits"), frame.limits);
    gl.uniform2f(used.at("size"), width, height);
    // A normalized filter works at every resolution; other filters match the training resolution and are scaled.
    const wider = 1 + (1 - header.compensate) * (Math.max(1, frame.enlarged) ** 2 - 1);
    gl.uniform3f(used.at("filters"), header.near, header.variance * wider, header.compensate);
    gl.uniform1i(used.at("mode"), MODES.indexOf(mode));
    gl.uniform1f(used.at("dot_radius"), dot);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(layer.array);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, layer.drawn);
    return target;
  }

  sized(width, height) {
    const gl = this.gl;
    if (this.target.width !== width || this.target.height !== height) {
      gl.deleteTexture(this.target.texture);
      gl.deleteFramebuffer(this.target.frame);
      this.target = this.surface(width, height, gl.LINEAR);
    }
    return this.target;
  }

  // Show the target on an area of the canvas.  area: left, bottom, width, height, px.
  show(area, background, frame = null) {
    const gl = this.gl, used = this.present;
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.viewport(...area);
    gl.disable(gl.BLEND);
    this.bind(used, {target: this.target.texture});
    gl.uniform3fv(used.at("background"), background);
    gl.uniform4fv(used.at("area"), area);
    gl.bindVertexArray(this.empty);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // Return the target over a background as RGBA bytes, rows from the top.
  pixels(background) {
    const gl = this.gl, {width, height} = this.target, bytes = new Uint8Array(4 * width * height);
    const target = texture(gl, gl.RGBA8, width, height, gl.RGBA, gl.UNSIGNED_BYTE, null);
    const frame = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, target, 0);
    this.show([0, 0, width, height], background, frame);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    gl.deleteFramebuffer(frame);
    gl.deleteTexture(target);
    const rows = new Uint8ClampedArray(bytes.length), row = 4 * width;
    for (let y = 0; y < height; y++) rows.set(bytes.subarray(row * (height - 1 - y), row * (height - y)), row * y);
    return rows;
  }
}
