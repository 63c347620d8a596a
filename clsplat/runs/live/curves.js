// The reports of the run as three small curves.

const LOSS = 1, PSNR = 2, COUNT = 3; // indices in a point, after its step
const short = value => value >= 1e6 ? `${(value / 1e6).toFixed(2)} M` : formatCount(value);
const CURVES = {loss: [LOSS, v => v.toPrecision(3)], psnr: [PSNR, v => v.toFixed(1)], gaussians: [COUNT, short]};

class Curves {
  constructor() { this.clear(); }

  clear() {
    this.points = [];
    this.draw();
  }

  get last() { return this.points.at(-1)?.[0] ?? 0; }

  add(points) {
    if (!points.length) return;
    this.points.push(...points);
    this.draw();
  }

  draw() {
    const first = this.points[0]?.[0], span = this.last - first || 1;
    for (const [name, [place, text]] of Object.entries(CURVES)) {
      const points = this.points.filter(point => point[place] !== null); // a field has no Gaussians
      const values = points.map(point => point[place]), low = Math.min(...values), high = Math.max(...values);
      const line = points.map((point, i) => {
        const height = high > low ? (values[i] - low) / (high - low) : 0.5;
        return `${(100 * (point[0] - first) / span).toFixed(2)},${(96 - 92 * height).toFixed(2)}`;
      });
      find(name).querySelector("polyline").setAttribute("points", line.join(" "));
      find(name).querySelector("b").textContent = points.length ? text(values.at(-1)) : "–";
    }
  }
}
