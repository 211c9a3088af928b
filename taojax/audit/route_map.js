// Frame by frame, 2 of 3: the map and the time line.
const LEAST_HIGH = 220, MOST_HIGH = 600, EDGE = 26, FOOT = 30, ZOOMS = [1, 2, 4, 8, 16, 32];
const view = at("route-map"), still = at("route-still"), moving = at("route-moving");
let low = [Infinity, Infinity], high = [-Infinity, -Infinity], zoom = 0, frame = 0;
for (const points of [map, truth]) {
  for (let i = 0; i < points.length; i++) {
    low[i % 2] = Math.min(low[i % 2], points[i]);
    high[i % 2] = Math.max(high[i % 2], points[i]);
  }
}
const span = [high[0] - low[0] || 1, high[1] - low[1] || 1];
// A corridor takes the whole width, and no map is higher than it needs to be.
const isFlat = span[1] < 0.3 * span[0], WIDE = isFlat ? 1140 : 760;
document.querySelector(".route").classList.toggle("flat", isFlat);
const need = ((WIDE - 2 * EDGE) * span[1]) / span[0] + 2 * EDGE + FOOT;
const HIGH = Math.round(Math.max(LEAST_HIGH, Math.min(MOST_HIGH, need)));
const fit = Math.min((WIDE - 2 * EDGE) / span[0], (HIGH - 2 * EDGE - FOOT) / span[1]);
view.setAttribute("viewBox", `0 0 ${WIDE} ${HIGH}`);
document.querySelector("#route-map .scale").setAttribute("transform", `translate(18 ${HIGH - 12})`);
const scale = () => fit * ZOOMS[zoom];
const place = (points, i) => [points[2 * i] * scale(), -points[2 * i + 1] * scale()];
const known = (points, i) => !Number.isNaN(points[2 * i]);
const MARKS = {
  o: (x, y) => `M${x} ${y}m-3.2 0a3.2 3.2 0 1 0 6.4 0a3.2 3.2 0 1 0-6.4 0`,
  "^": (x, y) => `M${x} ${y}m-4.2 3.2h8.4l-4.2-7z`,
  s: (x, y) => `M${x} ${y}m-3.4-3.4h6.8v6.8h-6.8z`,
  X: (x, y) => `M${x} ${y}m-4.6-4.6l9.2 9.2m0-9.2l-9.2 9.2`,
  "|": (x, y) => `M${x} ${y}m0-5v10`,
  _: (x, y) => `M${x} ${y}m-5 0h10`,
};
const spot = (marker, [x, y]) => MARKS[marker](x.toFixed(1), y.toFixed(1));
const line = (points, from, to) => {
  let path = "", pen = "M";
  for (let i = from; i <= to; i++) {
    if (!known(points, i)) { pen = "M"; continue; }
    const [x, y] = place(points, i);
    path += `${pen}${x.toFixed(1)} ${y.toFixed(1)}`;
    pen = "L";
  }
  return path;
};
const drawStill = () => {
  still.replaceChildren();
  let path = "";
  for (let i = 0; 2 * i < map.length; i++) {
    const [x, y] = place(map, i);
    path += `M${x.toFixed(1)} ${y.toFixed(1)}h0`;
  }
  draw(still, "path", { class: "map-poses", d: path });
  run.kinds.forEach((kind, number) => {
    for (const isTest of [false, true]) {
      let marks = "";
      for (let i = 0; i < n; i++) {
        if (Number(run.kind[i]) === number && (run.split[i] === "t") === isTest) {
          marks += spot(kind.marker, place(truth, i));
        }
      }
      const faint = isTest ? "" : " faint";
      if (marks) draw(still, "path", { class: `mark ${kind.name}${faint}`, d: marks });
    }
  });
  const wanted = (0.22 * WIDE) / scale(), ten = 10 ** Math.floor(Math.log10(wanted));
  const bar = [5, 2, 1].map((f) => f * ten).find((length) => length <= wanted) || ten;
  at("route-bar").setAttribute("d", `M0 -5v5h${(bar * scale()).toFixed(1)}v-5`);
  at("route-length").textContent = `${number(bar)} m`;
  at("route-length").setAttribute("x", (bar * scale() / 2).toFixed(1));
};
const drawMoving = (i) => {
  moving.replaceChildren();
  const first = Math.max(0, i - Math.ceil(run.window / run.every) + 1);
  for (let rank = k - 1; rank >= 0; rank--) {
    const row = rows[i * k + rank];
    if (!row) continue;
    const [x, y] = place(map, row - 1);
    draw(moving, "circle", {
      class: rank ? "candidate" : "candidate best",
      cx: x.toFixed(1), cy: y.toFixed(1), r: (3 + 9 * share(i, rank) ** 2).toFixed(1),
    });
  }
  if (known(pose, i)) {
    const [a, b] = [place(truth, i), place(pose, i)];
    draw(moving, "path", { class: "gap", d: `M${a[0]} ${a[1]}L${b[0]} ${b[1]}` });
  }
  draw(moving, "path", { class: "truth halo", d: line(truth, first, i) });
  draw(moving, "path", { class: "truth", d: line(truth, first, i) });
  let answered = "";
  for (let j = first; j <= i; j++) if (known(pose, j)) answered += spot("s", place(pose, j));
  draw(moving, "path", { class: "answered", d: answered });
  const [x, y] = place(truth, i);
  draw(moving, "circle", { class: "here halo", cx: x, cy: y, r: 8 });
  draw(moving, "circle", { class: "here", cx: x, cy: y, r: 8 });
};
const aim = () => {
  const middle = zoom
    ? place(truth, frame)
    : [(low[0] + span[0] / 2) * scale(), -(low[1] + span[1] / 2) * scale()];
  const up = zoom ? 0 : FOOT / 2;
  const move = `translate(${(WIDE / 2 - middle[0]).toFixed(1)} ${(HIGH / 2 - up - middle[1]).toFixed(1)})`;
  still.setAttribute("transform", move);
  moving.setAttribute("transform", move);
  return [WIDE / 2 - middle[0], HIGH / 2 - up - middle[1]];
};

// ---- time line ----
const runs = (letters) => {
  const found = [];
  for (let i = 0, start = 0; i < letters.length; i++) {
    if (letters[i + 1] === letters[i]) continue;
    found.push([letters[i], start, i + 1 - start]);
    start = i + 1;
  }
  return found;
};
const strip = at("route-strip");
const drawStrip = () => {
  strip.setAttribute("viewBox", `0 0 ${n} 70`);
  for (const [letter, x, width] of runs(run.label)) {
    draw(strip, "rect", { class: `truth-${letter}`, x, width, y: 0, height: 12 });
  }
  for (const [letter, x, width] of runs(run.kind)) {
    const name = run.kinds[Number(letter)].name;
    draw(strip, "rect", { class: `band ${name}`, x, width, y: 15, height: 12 });
  }
  let path = "", pen = "M";
  for (let i = 0; i < n; i++) {
    const p = value(doubt, i);
    if (Number.isNaN(p)) { pen = "M"; continue; }
    path += `${pen}${i + 0.5} ${(69 - 38 * p).toFixed(1)}`;
    pen = "L";
  }
  draw(strip, "path", { class: "chance", d: path });
  if (run.model.threshold !== null) {
    const y = (69 - 38 * run.model.threshold).toFixed(1);
    draw(strip, "path", { class: "level", d: `M0 ${y}H${n}` });
  }
  const test = run.split.indexOf("t");
  if (test > 0) draw(strip, "path", { class: "cut", d: `M${test} 0V70` });
  draw(strip, "path", { id: "route-cursor", class: "cursor", d: "M0 0V70" });
};
