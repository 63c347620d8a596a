// The settings and statistics of a page that renders the model itself.

class Settings extends Panel {
  constructor(viewer) {
    super(viewer);
    choices("modes", "mode", mode => this.mode(mode));
    choices("backgrounds", "background", name => this.background(name));
    find("share").addEventListener("input", ({target}) => {
      viewer.share = target.value / 100;
      this.shares();
      viewer.change();
    });
    find("field").addEventListener("input", ({target}) => viewer.widen(+target.value));
    this.shares();
  }

  mode(mode) {
    this.viewer.mode = mode;
    markPressed("modes", "mode", mode);
    this.viewer.change();
  }

  background(name) {
    this.viewer.background = {black: [0, 0, 0], white: [1, 1, 1], gray: [0.22, 0.23, 0.26]}[name];
    markPressed("backgrounds", "background", name);
    this.viewer.change();
  }

  shares() {
    find("share").value = 100 * this.viewer.share;
    find("shared").textContent = `${Math.round(100 * this.viewer.share)} %`;
  }

  field([fx, fy, , , width, height]) {
    const angle = Math.atan(Math.min(width / fx, height / fy) / 2) * 360 / Math.PI;
    find("field").value = angle;
    find("angle").textContent = `${Math.round(angle)}°`;
  }

  // ms: of a frame during motion, or null; scale: of the resolution
  statistics(ms, scale) {
    const {layers} = this.viewer;
    const parts = layers.map(({drawn, header: {name, count, faint, sky}}) =>
      `${layers.length > 1 ? `${name}: ` : ""}${formatCount(drawn)} of ${formatCount(count)} splats` +
      (sky ? `, ${formatCount(sky)} of the sky` : "") +
      (faint ? ` + ${formatCount(faint)} too faint to draw` : ""));
    if (ms !== null) parts.push(`${ms < 10 ? ms.toFixed(1) : Math.round(ms)} ms per frame`);
    if (scale < 1) parts.push(`${Math.round(100 * scale)} % resolution`);
    if (this.viewer.distance) parts.push(`distance of the last two points: ${this.viewer.distance.toPrecision(4)}`);
    find("statistics").textContent = parts.join(" · ");
  }
}
