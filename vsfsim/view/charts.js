// Beside the object: curves over travel, the picture with its targets, and the legend.

// Values over travel: the chosen touch with its frames, the others faint; a frame that did not converge is a cross.
function curve(canvas, title, of) {
  const pen = fitted(canvas), d = devicePixelRatio, {width, height} = canvas;
  const [left, right, top, bottom] = [44 * d, width - 10 * d, 20 * d, height - 30 * d];
  const all = shown.o.touches.filter(t => of(t));
  const x = all.flatMap(t => t.travel), y = all.flatMap(of).filter(v => v !== null).concat(0);
  const [x0, x1, y0, y1] = [Math.min(...x), Math.max(...x), Math.min(...y), Math.max(...y)];
  const at = (t, k, value) => [left + (t.travel[k] - x0) / (x1 - x0 || 1) * (right - left),
                               bottom - ((value ?? 0) - y0) / (y1 - y0 || 1) * (bottom - top)];
  const spot = (t, k) => at(t, k, of(t)[k]);
  line(pen, [[left, top], [left, bottom], [right, bottom]], colour("faint"), 1);
  pen.fillStyle = colour("front");
  pen.font = `${11 * d}px system-ui`;
  pen.fillText(title, 4 * d, 12 * d);
  pen.textAlign = "right";
  pen.fillText(number(y1, 2), left - 4 * d, top + 8 * d);
  pen.fillText(number(y0, 2), left - 4 * d, bottom);
  pen.fillText(`travel ${number(1e3 * x1, 2)} mm`, right, bottom + 16 * d);
  pen.textAlign = "left";
  pen.fillText(`${number(1e3 * x0, 2)} mm`, left, bottom + 16 * d);
  const path = t => t.travel.map((_, k) => k).filter(k => of(t)[k] !== null).map(k => spot(t, k));
  const chosen = shown.o.touches[state.touch];
  pen.globalAlpha = 0.25;
  all.filter(t => t !== chosen).forEach(t => line(pen, path(t), colour("touch"), 1));
  pen.globalAlpha = 1;
  line(pen, path(chosen), colour("chosen"), 2);
  chosen.travel.forEach((_, k) => {
    const [px, py] = spot(chosen, k), r = (k === state.frame ? 5 : 2.5) * d;
    if (!chosen.converged[k]) {
      line(pen, [[px - r, py - r], [px + r, py + r]], colour("bad"), 2);
      line(pen, [[px - r, py + r], [px + r, py - r]], colour("bad"), 2);
      return;
    }
    pen.fillStyle = colour(k === state.frame ? "push" : "chosen");
    pen.beginPath();
    pen.arc(px, py, r, 0, 7);
    pen.fill();
  });
}

function showPictures(picture) {
  $("depth-range").textContent = `depth, ${picture.near} m (light) to ${picture.far} m (dark)`;
  for (const name of ["rgb", "depth"]) {
    const image = new Image();
    image.onload = () => {
      if (shown.o.picture !== picture) return;
      picture[`${name}Image`] = image;
      drawTargets();
    };
    image.src = picture[name];
  }
}
function drawTargets() {
  const {picture, touches} = shown.o;
  if (!picture) return;
  for (const name of ["rgb", "depth"]) {
    const image = picture[`${name}Image`], canvas = $(name);
    if (!image) continue;
    Object.assign(canvas, {width: image.width, height: image.height});
    const pen = canvas.getContext("2d");
    pen.drawImage(image, 0, 0);
    touches.forEach((touch, k) => {
      const p = picture.to_camera.slice(0, 3).map(row => row[3] + touch.target.reduce((s, v, n) => s + row[n] * v, 0));
      const q = picture.intrinsics.map(row => row.reduce((s, v, n) => s + v * p[n], 0));
      pen.strokeStyle = colour(k === state.touch ? "chosen" : "touch");
      pen.lineWidth = k === state.touch ? 3 : 1.5;
      pen.beginPath();
      pen.arc(q[0] / q[2] + 0.5, q[1] / q[2] + 0.5, k === state.touch ? 7 : 3, 0, 7);
      pen.stroke();
    });
  }
}

function legend() {
  const part = (tag, name, text) => Object.assign(document.createElement(tag), {className: name, textContent: text});
  const box = $("legend");
  const scale = (what, colours, at) => {                 // at: the words at a share of the bar
    const bar = part("div", "bar", ""), ticks = part("div", "ticks", "");
    bar.style.background = `linear-gradient(to top, ${colours.join(",")})`;
    for (const share of [0, 0.25, 0.5, 0.75, 1]) {
      const tick = part("span", "", at(share));
      tick.style.top = `${100 - 100 * share}%`;
      ticks.append(tick);
    }
    const whole = part("div", "scale", what);
    whole.append(part("div", "", ""), bar, ticks);
    box.append(whole);
  };
  if (maps.length) scale(quantity, VIRIDIS, share => withUnit(lowest + share * (highest - lowest)));
  const most = Math.max(0, ...data.objects.map(o => o.pressure?.span[0] ?? 0));
  if (most > 0) scale("contact pressure, mean over elements", ["transparent", PRESSED],
                      share => `${number(share * most / 1e3, 2)} kPa`);
  if (data.objects.some(o => o.touches.length)) {
    const key = part("div", "key", "");
    for (const [name, text] of [["touch", "touch: where and how it presses"], ["chosen", "chosen touch and its probe"],
                                ["push", "force on the probe, in this frame"]]) {
      const row = part("div", "", text), stroke = part("i", "", "");
      stroke.style.background = `var(--${name})`;
      row.prepend(stroke);
      key.append(row);
    }
    box.append(key);
  }
}
