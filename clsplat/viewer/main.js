// The page: when to draw, and at which quality.

const REST_MS = 200, SLOW_FRAME_MS = 40, FAST_FRAME_MS = 20; // ms without a change before the full image; ms per frame

class Viewer extends PageCamera {
  constructor(info, layers, painter, canvas) {
    super(info, canvas);
    Object.assign(this, {layers, painter, mode: "splats", share: 1, quality: 1, ms: null, timestamp: 0});
    this.background = info.background;
    for (const layer of layers) {
      layer.sorter = new Sorter(layer.positions, layer.motion, layer.header.near, (order, first) => {
        painter.reorder(layer, order);
        layer.first = first;
        this.change(false);
      });
    }
    this.panel = new Settings(this);
    this.photographs = new Photographs(this, info.views);
    this.frustums = new Frustums(this, info.views);
    this.controls = new Controls(this, canvas);
    if (info.timestamps) this.clock = new Clock(this, info.timestamps);
    this.photographs.compare("off");
    new ResizeObserver(() => { this.photographs.place(); this.change(); }).observe(this.stage);
    addEventListener("hashchange", () => this.readAddress());
    if (!this.readAddress() && info.first >= 0) this.photographs.choose(info.first, 0);
    this.change();
  }

  // Draw again; moved: whether the camera or a setting changed.
  change(moved = true) {
    if (moved) this.changed = performance.now();
    this.dirty = true;
    delete document.documentElement.dataset.ready;
    this.scheduled ??= requestAnimationFrame(time => this.tick(time));
  }

  // The size of a model's part of the stage, CSS px: halves side by side, or one above the other.
  pane() {
    const {clientWidth: width, clientHeight: height} = this.stage, parts = this.layers.length;
    return width >= height ? {width: width / parts, height} : {width, height: height / parts};
  }

  tick(time) {
    this.scheduled = undefined;
    const passed = time - (this.time ?? time);
    this.time = time;
    if (this.flight) this.advance(time);
    if (this.controls.fly(passed / 1000) || this.flight) this.change();
    this.clock?.run(passed / 1000);
    const resting = performance.now() - this.changed > REST_MS;
    if (!resting && this.drew) this.adapt(passed);
    this.drew = this.dirty || (resting && !this.whole);
    if (this.drew) this.draw(resting);
    const moves = this.flight || this.clock?.playing || this.controls.pressed.size;
    if (this.whole && !moves) this.time = undefined; // a new sorting order draws again
    else this.scheduled ??= requestAnimationFrame(later => this.tick(later));
  }

  // During motion, adapt resolution and number of splats to the frame time.
  adapt(passed) {
    if (passed <= 0) return;
    this.ms = this.ms === null ? passed : 0.8 * this.ms + 0.2 * passed;
    if (passed > SLOW_FRAME_MS) this.quality = Math.max(0.02, this.quality * Math.max(0.5, 30 / passed));
    else if (passed < FAST_FRAME_MS) this.quality = Math.min(1, this.quality * 1.1);
  }

  // The number of splats of a layer to draw: a whole number of parts, the most important first.
  first({header, count}, share) {
    return Math.min(count, header.levels[Math.max(1, Math.round(share * header.levels.length)) - 1]);
  }

  draw(resting) {
    const scale = resting ? 1 : Math.max(0.4, Math.sqrt(this.quality));
    const share = resting ? this.share : this.share * Math.min(1, this.quality / scale ** 2);
    const ratio = Math.min(2, devicePixelRatio || 1), {width, height} = this.pane();
    const wide = Math.max(1, Math.round(width * ratio)), high = Math.max(1, Math.round(height * ratio));
    const along = this.stage.clientWidth >= this.stage.clientHeight, parts = this.layers.length;
    const [whole, tall] = along ? [wide * parts, high] : [wide, high * parts];
    if (this.canvas.width !== whole) this.canvas.width = whole;
    if (this.canvas.height !== tall) this.canvas.height = tall;
    const exact = this.at >= 0, native = exact ? this.camera.lens[0] : this.info.focal;
    const [across, down] = [wide, high].map(side => Math.max(1, Math.round(side * scale)));
    const frame = makeFrame(this.camera, across, down, exact, native);
    this.layers.forEach((layer, i) => {
      layer.sorter.ask([...axis(this.camera, 2), frame.translation[2]], this.first(layer, share), this.timestamp);
      const {mode, timestamp} = this, dot = Math.max(1, 1.5 * ratio * scale);
      this.painter.blend(layer, frame, {mode, first: layer.first, dot, timestamp});
      const corner = along ? [i * wide, 0] : [0, (parts - 1 - i) * high];
      this.painter.show([...corner, wide, high], this.background);
    });
    const corners = this.layers.map((_, i) => along ? [i * width, 0] : [0, i * height]);
    this.frustums.draw(makeFrame(this.camera, width, height, exact), corners, ratio);
    this.dirty = false;
    this.whole = resting;
    this.panel.statistics(this.ms, scale);
    if (resting && !this.flight && this.layers.every(layer => layer.sorter.current)) this.settle();
  }

  settle() {
    this.panel.field(this.camera.lens);
    this.storeInAddress();
    document.documentElement.dataset.ready = "1";
  }

  // Rotate about the nearest splat that covers a pixel of the stage, and measure its distance from the previous pivot.
  focus(x, y) {
    const {width, height} = this.pane(), [u, v] = [x % width, y % height], [layer] = this.layers;
    const frame = makeFrame(this.camera, width, height, false), rows = [0, 1, 2].map(i => axis(this.camera, i));
    const [fx, fy, cx, cy] = frame.intrinsics, {motion} = layer;
    let nearest = Infinity, hit;
    for (let i = 0; i < layer.count; i++) {
      const point = [layer.points[4 * i], layer.points[4 * i + 1], layer.points[4 * i + 2]];
      const dt = motion ? this.timestamp - motion.rows[i * motion.stride + 3] : 0;
      if (motion) for (let axis = 0; axis < 3; axis++) point[axis] += displacement(motion, i, axis, dt);
      const depth = dot(rows[2], point) + frame.translation[2];
      if (depth < layer.header.near || depth > nearest) continue;
      if (layer.opacities[i] * (motion ? opacityFactor(motion, i, dt) : 1) < 0.4) continue;
      const across = fx * (dot(rows[0], point) + frame.translation[0]) / depth + cx - u;
      const down = fy * (dot(rows[1], point) + frame.translation[1]) / depth + cy - v;
      if (across * across + down * down < 64) [nearest, hit] = [depth, point];
    }
    if (!hit) return;
    this.distance = this.hit && size(add(hit, this.hit, -1));
    this.pivot = this.hit = hit;
    this.change(false);
  }

  // Save the current image as a file.
  screenshot() {
    this.draw(true);
    this.canvas.toBlob(blob => {
      const link = document.createElement("a");
      link.href = URL.createObjectURL(blob);
      link.download = `${this.info.file}.png`;
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 1000);
    });
  }

  // The pixels of a view at its own size, after `choose` and once the page is at rest: {width, height, data}.
  capture(part = 0) {
    const [width, height] = this.camera.lens.slice(4), layer = this.layers[part];
    this.painter.blend(layer, makeFrame(this.camera, width, height, true, this.camera.lens[0]),
      {first: layer.first, timestamp: this.timestamp});
    return {width, height, data: this.painter.pixels(this.background)};
  }
}

async function open() {
  const canvas = find("canvas"), info = JSON.parse(find("scene").textContent);
  const painter = new Painter(canvas), layers = [];
  canvas.addEventListener("webglcontextlost", () => fail("the graphics device was lost; reload the page"));
  for (const [i, header] of info.models.entries()) {
    const script = find(`model${i}`), buffer = await inflate(script.textContent.trim());
    script.remove(); // its text is no longer needed
    const data = unpackModel(header, buffer, painter.maxSize), points = new Float32Array(data.places.buffer);
    const opacities = Float32Array.from(data.sizes, word => data.tables[256 + (word >>> 24)]);
    const {positions} = data, motion = data.motion &&
      {rows: data.motion.rows, stride: 4 * data.motion.wide, bends: header.motion.bends};
    layers.push({...painter.layer(header, data), positions, motion, points, opacities, first: 0});
  }
  window.viewer = new Viewer(info, layers, painter, canvas);
  find("message").hidden = true;
}

open().catch(fail);
