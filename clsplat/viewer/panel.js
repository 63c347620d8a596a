// What stands around the picture: buttons, settings, help, statistics.

const find = name => document.getElementById(name);
const press = (group, key, value) => {
  for (const button of find(group).querySelectorAll("button")) {
    button.setAttribute("aria-pressed", button.dataset[key] === value);
  }
};
const choices = (group, key, action) => find(group).addEventListener("click", ({target}) => {
  if (target.dataset[key]) action(target.dataset[key]);
});
const thousands = number => number.toLocaleString("en");

class Panel {
  constructor(viewer) {
    this.viewer = viewer;
    for (const [name, action] of Object.entries({
      help: () => this.help(), settings: () => this.toggle(), screenshot: () => viewer.screenshot(),
      fullscreen: () => this.fullscreen(), reset: () => viewer.reset(), show: () => this.hide(),
    })) find(name).addEventListener("click", action);
    choices("modes", "mode", mode => this.mode(mode));
    choices("styles", "style", style => this.style(style));
    choices("cameras", "cameras", state => this.cameras(state === "shown"));
    choices("backgrounds", "background", name => this.background(name));
    find("share").addEventListener("input", ({target}) => {
      viewer.share = target.value / 100;
      this.shares();
      viewer.change();
    });
    find("field").addEventListener("input", ({target}) => viewer.widen(+target.value));
    find("keys").addEventListener("click", ({target}) => { // the button, or outside of the box
      if (target.closest("button") || target === find("keys")) find("keys").close();
    });
    if (!document.fullscreenEnabled) find("fullscreen").hidden = true;
    this.shares();
  }

  toggle() {
    find("panel").hidden = !find("panel").hidden;
    find("settings").setAttribute("aria-expanded", !find("panel").hidden);
  }

  help() {
    if (find("keys").open) find("keys").close();
    else find("keys").showModal();
  }

  hide() {
    find("show").hidden = !document.body.classList.toggle("bare");
  }

  fullscreen() {
    if (document.fullscreenElement) document.exitFullscreen();
    else document.documentElement.requestFullscreen?.().catch(() => {});
  }

  mode(mode) {
    this.viewer.mode = mode;
    press("modes", "mode", mode);
    this.viewer.change();
  }

  style(style) {
    this.viewer.controls.style = style;
    press("styles", "style", style);
  }

  cameras(shown) {
    this.viewer.frustums.shown = shown;
    press("cameras", "cameras", shown ? "shown" : "hidden");
    this.viewer.change();
  }

  background(name) {
    this.viewer.background = {black: [0, 0, 0], white: [1, 1, 1], grey: [0.22, 0.23, 0.26]}[name];
    press("backgrounds", "background", name);
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

  caption(view) {
    find("caption").textContent = view ? view.name : "";
    find("split").textContent = view ? view.split : "";
    find("split").className = view ? view.split : "";
  }

  // drawn: splats; ms: of a frame while moving, null when not measured; scale: of the picture's resolution
  statistics(drawn, ms, scale) {
    const whole = this.viewer.layers.reduce((sum, layer) => sum + layer.header.count, 0);
    const parts = [`${thousands(drawn)} of ${thousands(whole)} splats`];
    if (ms !== null) parts.push(`${ms < 10 ? ms.toFixed(1) : Math.round(ms)} ms a frame`);
    if (scale < 1) parts.push(`${Math.round(100 * scale)} % resolution`);
    find("statistics").textContent = parts.join(" · ");
  }
}

function fail(error) {
  const box = find("message");
  box.hidden = false;
  box.textContent = `The scene cannot be shown: ${error.message || error}.`;
  document.documentElement.dataset.failed = "1";
}
