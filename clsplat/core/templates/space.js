for (const box of document.querySelectorAll(".space")) {
  const {points, colors, cameras, names, shades, radius} = JSON.parse(box.querySelector("script").textContent);
  const canvas = box.querySelector("canvas"), pen = canvas.getContext("2d"), caption = box.querySelector("output");
  const VIEWS = {oblique: [0.6, 0.45], top: [0, Math.PI / 2], side: [0, 0]};
  let [yaw, pitch] = VIEWS.oblique, distance = 2.7 * radius, places = [], over = -1;

  // Rotated about the up axis, then tilted toward the viewer; null behind the eye.
  function project(x, y, z, wide, high) {
    const a = Math.cos(yaw) * x - Math.sin(yaw) * y, b = Math.sin(yaw) * x + Math.cos(yaw) * y;
    const depth = distance + Math.cos(pitch) * b - Math.sin(pitch) * z;
    if (depth < 0.02 * distance) return null;
    const scale = 1.25 * high / depth;
    return [wide / 2 + a * scale, high / 2 - (Math.sin(pitch) * b + Math.cos(pitch) * z) * scale, depth];
  }

  // The place of a camera outside the canvas: where the line from the middle to it crosses the border.
  function clamped(camera, wide, high) {
    const a = Math.cos(yaw) * camera[1] - Math.sin(yaw) * camera[2];
    const b = Math.sin(yaw) * camera[1] + Math.cos(yaw) * camera[2];
    const dx = a, dy = -(Math.sin(pitch) * b + Math.cos(pitch) * camera[3]);
    const t = Math.min((wide / 2 - 14) / Math.abs(dx || 1e-9), (high / 2 - 14) / Math.abs(dy || 1e-9));
    return [wide / 2 + dx * t, high / 2 + dy * t];
  }

  function draw() {
    const wide = canvas.clientWidth, high = canvas.clientHeight, dense = devicePixelRatio || 1;
    if (canvas.width !== Math.round(wide * dense) || canvas.height !== Math.round(high * dense)) {
      canvas.width = Math.round(wide * dense);
      canvas.height = Math.round(high * dense);
    }
    pen.setTransform(dense, 0, 0, dense, 0, 0);
    pen.clearRect(0, 0, wide, high);
    for (let i = 0; i < colors.length; i++) {
      const place = project(points[3 * i], points[3 * i + 1], points[3 * i + 2], wide, high);
      if (!place) continue;
      const size = Math.min(5, Math.max(1.2, 2.3 * distance / place[2]));
      pen.fillStyle = "#" + colors[i];
      pen.fillRect(place[0] - size / 2, place[1] - size / 2, size, size);
    }
    places = cameras.map((camera, i) => {
      const corners = [];
      for (let k = 1; k < 16; k += 3) corners.push(project(camera[k], camera[k + 1], camera[k + 2], wide, high));
      let center = corners[0];
      const outside = !center || center[0] < 0 || center[0] > wide || center[1] < 0 || center[1] > high;
      pen.strokeStyle = pen.fillStyle = i === over ? "#ffffff" : shades[camera[0]];
      pen.lineWidth = i === over ? 2 : 1.2;
      if (camera[0] === 2 && outside) {
        center = clamped(camera, wide, high);
        label(center, names[i] + " (far outside)", wide);
      } else if (camera[0] === 2) label(center, names[i], wide);
      else if (corners.every(Boolean)) frustum(corners);
      return center;
    });
    if (over >= 0 && places[over]) caption.textContent = names[over];
    else caption.textContent = "";
  }

  function frustum([center, ...corners]) {
    pen.beginPath();
    corners.forEach((corner, k) => {
      const next = corners[(k + 1) % 4];
      pen.moveTo(center[0], center[1]);
      pen.lineTo(corner[0], corner[1]);
      pen.lineTo(next[0], next[1]);
    });
    pen.stroke();
  }

  function label([x, y], text, wide) {
    pen.beginPath();
    pen.arc(x, y, 5, 0, 7);
    pen.fill();
    pen.font = "12px system-ui";
    pen.textAlign = x > wide / 2 ? "right" : "left";
    pen.fillText(text, x + (x > wide / 2 ? -10 : 10), y + 4);
  }

  canvas.addEventListener("pointerdown", event => canvas.setPointerCapture(event.pointerId));
  canvas.addEventListener("pointermove", event => {
    if (event.buttons) {
      yaw += event.movementX / 150;
      pitch = Math.max(-Math.PI / 2, Math.min(Math.PI / 2, pitch + event.movementY / 150));
    } else {
      const reach = places.map(p => p ? Math.hypot(p[0] - event.offsetX, p[1] - event.offsetY) : 1e9);
      const nearest = reach.indexOf(Math.min(...reach));
      over = reach[nearest] < 14 ? nearest : -1;
    }
    draw();
  });
  canvas.addEventListener("wheel", event => {
    event.preventDefault();
    distance = Math.max(0.2 * radius, Math.min(300 * radius, distance * Math.exp(event.deltaY / 600)));
    draw();
  }, {passive: false});
  box.querySelector("nav").addEventListener("click", event => {
    const view = VIEWS[event.target.dataset.view];
    if (!view) return;
    [yaw, pitch] = view;
    distance = 2.7 * radius;
    draw();
  });
  addEventListener("resize", draw);
  draw();
}
