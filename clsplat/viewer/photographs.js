// The filmstrip of views, and the photo of the chosen view over the render.

const COMPARISONS = ["off", "slider", "blink", "fade"], BLINK_MS = 600;

// The prefix that all names share, up to a separator, such as "images/IMG_2024_".
function commonPrefix([first = "", ...others]) {
  let length = first.length;
  for (const name of others) while (!name.startsWith(first.slice(0, length))) length--;
  return first.slice(0, length).match(others.length ? /^.*[/_ -]/ : /^.*[/]/)?.[0] ?? "";
}

class Photographs {
  constructor(viewer, views) {
    Object.assign(this, {viewer, views, chosen: -1, comparison: "off", share: 0.5});
    this.strip = document.getElementById("strip");
    this.frame = document.getElementById("frame");
    this.image = this.frame.querySelector("img");
    this.bar = document.getElementById("comparison");
    this.range = this.bar.querySelector("input");
    this.line = this.frame.querySelector("i");
    const prefix = commonPrefix(views.map(view => view.name));
    const [extension] = views[0]?.name.match(/\.\w+$/) ?? [""];
    const end = views.every(view => view.name.endsWith(extension)) ? -extension.length || undefined : undefined;
    this.items = views.map((view, i) => this.item(view, i, view.name.slice(prefix.length, end)));
    choices("comparison", "comparison", name => this.compare(name));
    this.range.addEventListener("input", () => { this.share = this.range.value / 100; this.place(); });
    this.line.addEventListener("pointerdown", event => this.line.setPointerCapture(event.pointerId));
    this.line.addEventListener("pointermove", event => {
      if (!event.buttons) return;
      const {left, width} = this.frame.getBoundingClientRect();
      this.share = Math.max(0, Math.min(1, (event.clientX - left) / width));
      this.range.value = 100 * this.share;
      this.place();
    });
    if (!views.length) this.strip.remove();
  }

  item(view, i, label) {
    const [item, image, name] = ["button", "img", "span"].map(kind => document.createElement(kind));
    item.className = view.split;
    item.title = `${view.name} (${view.split})${view.photograph ? "" : ", photo not included"}`;
    if (!view.thumbnail.startsWith("data:")) image.loading = "lazy"; // a server has to read it first
    image.src = view.thumbnail;
    image.alt = "";
    [image.width, image.height] = [Math.round(64 * view.lens[4] / view.lens[5]), 64];
    image.draggable = false;
    const width = Math.min(Math.max(image.width, 44), 160); // px, as in viewer.css
    const fitting = Math.floor((width - 10) / 6); // characters; the ends of names differ most
    name.textContent = label.length > fitting ? `…${label.slice(1 - fitting)}` : label;
    item.append(image, name);
    item.addEventListener("click", () => this.choose(i));
    this.strip.append(item);
    return item;
  }

  // Go to the exact camera of a view.
  choose(i, seconds = 0.7) {
    this.leave();
    this.chosen = i;
    this.items[i].setAttribute("aria-current", "true");
    this.items[i].scrollIntoView({behavior: seconds ? "smooth" : "instant", block: "nearest", inline: "center"});
    const {clock} = this.viewer, {time} = this.views[i];
    if (clock && time !== undefined) {
      clock.stop();
      clock.to(time);
    }
    this.viewer.fly(cameraOf(this.views[i]), seconds, i);
  }

  step(by) {
    if (!this.views.length) return;
    const last = this.chosen >= 0 ? this.chosen : this.last ?? (by > 0 ? -1 : 0);
    this.choose((last + by + this.views.length) % this.views.length);
  }

  // The camera has arrived at the view: its photo can be shown.
  arrived() {
    const view = this.views[this.chosen];
    this.frame.hidden = false;
    this.bar.hidden = !view.photograph;
    if (view.photograph) this.image.src = view.photograph;
    else this.image.removeAttribute("src");
    this.viewer.panel.caption(view);
    this.place();
  }

  // The camera leaves the view.
  leave() {
    if (this.chosen < 0) return;
    this.items[this.chosen].removeAttribute("aria-current");
    [this.last, this.chosen] = [this.chosen, -1];
    this.frame.hidden = this.bar.hidden = true;
    this.viewer.panel.caption(null);
  }

  compare(comparison) {
    this.comparison = comparison;
    markPressed("comparison", "comparison", comparison);
    this.range.hidden = comparison !== "fade";
    clearInterval(this.timer);
    this.lit = true;
    if (comparison === "blink") this.timer = setInterval(() => { this.lit = !this.lit; this.place(); }, BLINK_MS);
    this.place();
  }

  cycle() {
    if (!this.bar.hidden) this.compare(COMPARISONS[(COMPARISONS.indexOf(this.comparison) + 1) % COMPARISONS.length]);
  }

  // Place the photo exactly over the area that its camera shows.
  place() {
    if (this.frame.hidden || this.chosen < 0) return;
    const {width, height} = this.viewer.pane(), {lens} = this.views[this.chosen];
    const {enlarged, left, top} = fitToCanvas(lens, width, height);
    const box = {left, top, width: lens[4] * enlarged, height: lens[5] * enlarged};
    for (const [name, length] of Object.entries(box)) this.frame.style[name] = `${length}px`;
    const shown = this.comparison !== "off" && this.image.hasAttribute("src");
    const slides = this.comparison === "slider";
    this.image.hidden = !shown || (this.comparison === "blink" && !this.lit);
    this.image.style.opacity = this.comparison === "fade" ? this.share : 1;
    this.image.style.clipPath = slides ? `inset(0 ${100 * (1 - this.share)}% 0 0)` : "none";
    this.line.hidden = !shown || !slides;
    this.line.style.left = `${100 * this.share}%`;
    for (const label of this.frame.querySelectorAll("b")) label.hidden = !shown || !slides;
  }
}
