// The controls around the image: buttons, help, the name of the view.

const find = name => document.getElementById(name);
const markPressed = (group, key, value) => {
  for (const button of find(group).querySelectorAll("button")) {
    button.setAttribute("aria-pressed", button.dataset[key] === value);
  }
};
const choices = (group, key, action) => find(group).addEventListener("click", ({target}) => {
  if (target.dataset[key]) action(target.dataset[key]);
});
const formatCount = number => number.toLocaleString("en");
const CAPTION_MS = 4000;

class Panel {
  constructor(viewer) {
    this.viewer = viewer;
    for (const [name, action] of Object.entries({
      help: () => this.help(), settings: () => this.toggle(), screenshot: () => viewer.screenshot(),
      fullscreen: () => this.fullscreen(), reset: () => viewer.reset(), show: () => this.hide(),
    })) find(name).addEventListener("click", action);
    choices("styles", "style", style => this.style(style));
    choices("cameras", "cameras", state => this.cameras(state === "shown"));
    find("keys").addEventListener("click", ({target}) => { // the button, or outside the dialog
      if (target.closest("button") || target === find("keys")) find("keys").close();
    });
    if (!document.fullscreenEnabled) find("fullscreen").hidden = true;
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

  style(style) {
    this.viewer.controls.style = style;
    markPressed("styles", "style", style);
  }

  cameras(shown) {
    this.viewer.frustums.shown = shown;
    markPressed("cameras", "cameras", shown ? "shown" : "hidden");
    this.viewer.change();
  }

  // Show a message in the caption for a while.
  showMessage(text) {
    const caption = find("caption");
    caption.textContent = text;
    setTimeout(() => { if (caption.textContent === text) caption.textContent = ""; }, CAPTION_MS);
  }

  caption(view) {
    find("caption").textContent = view ? view.name : "";
    find("split").textContent = view ? view.split : "";
    find("split").className = view ? view.split : "";
  }
}

function fail(error) {
  const box = find("message");
  box.hidden = false;
  box.textContent = `The scene cannot be shown: ${error.message || error}.`;
  document.documentElement.dataset.failed = "1";
}
