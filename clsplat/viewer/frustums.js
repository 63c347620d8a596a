// The cameras of the views as small pyramids over the image.

const DEPTH = 0.07, COLOR = {train: "#63b3ed", test: "#f6ad55"}; // depth of a pyramid, in radii of the scene

class Frustums {
  constructor(viewer, views) {
    Object.assign(this, {viewer, canvas: find("frustums"), shown: false});
    this.shapes = views.map(view => {
      const {rotation, eye, lens: [fx, fy, cx, cy, width, height]} = cameraOf(view), far = DEPTH * viewer.radius;
      const corners = [[0, 0], [width, 0], [width, height], [0, height]].map(([x, y]) => {
        const ray = [(x - cx) / fx, (y - cy) / fy, 1];
        return eye.map((v, i) => v + far * (ray[0] * rotation[i] + ray[1] * rotation[3 + i] + rotation[6 + i]));
      });
      return {points: [eye, ...corners], color: COLOR[view.split]};
    });
    if (!views.length) find("cameras").previousElementSibling.hidden = find("cameras").hidden = true;
  }

  // frame: from `makeFrame`, for a pane of that size in CSS px; corners: left and top of each pane
  draw(frame, corners, ratio) {
    const context = this.canvas.getContext("2d"), {width, height} = this.viewer.canvas;
    this.canvas.hidden = !this.shown;
    if (!this.shown) return;
    Object.assign(this.canvas, {width, height}); // this also clears the canvas
    for (const [left, top] of corners) {
      context.setTransform(ratio, 0, 0, ratio, left * ratio, top * ratio);
      context.lineWidth = 1.3;
      for (const {points, color} of this.shapes) {
        context.strokeStyle = color;
        this.pyramid(context, points.map(point => projectPoint(frame, point)));
      }
    }
  }

  pyramid(context, points) {
    if (!points.every(Boolean)) return;
    const [tip, ...corners] = points;
    context.beginPath();
    corners.forEach((corner, i) => {
      context.moveTo(...tip);
      context.lineTo(...corner);
      context.lineTo(...corners[(i + 1) % 4]);
    });
    context.stroke();
  }
}

// Project a point of the world to the canvas of a frame; null if it is behind the camera.
function projectPoint({rotation, translation, intrinsics: [fx, fy, cx, cy]}, point) {
  const [x, y, z] = [0, 1, 2].map(i => dot(rotation.slice(3 * i, 3 * i + 3), point) + translation[i]);
  return z > 0 ? [fx * x / z + cx, fy * y / z + cy] : null;
}
