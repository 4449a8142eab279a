"use strict";
/* Plans of where starts are: packed points, walls in outline, and a chart for each view. */

const KINDS = [
  { name: "too hard", colour: "--low" },
  { name: "good", colour: "--good" },
  { name: "mastered", colour: "--high" },
  { name: "too few episodes", colour: "--unlabelled" },
];
const OUTCOMES = [
  { name: "not reached", colour: "--low" },
  { name: "reached", colour: "--high" },
];
const AXIS_WIDTH = 60, AXIS_HEIGHT = 48, PADDING = 8;

/* Colours by name, asked for each point of a picture; forgotten when the ground changes. */
const painted = new Map();
function css(name) {
  if (!painted.has(name)) painted.set(name, getComputedStyle(document.documentElement).getPropertyValue(name).trim());
  return painted.get(name);
}

function unpack(text, Type) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  return new Type(bytes.buffer);
}

/* Points of one axis pair from packed integers; null where a point lies outside. */
function place(packed, k, axes, unit) {
  if (packed[3 * k] === -32768) return null;
  const [i, j] = axes;
  return { x: unit.centre[i] + packed[3 * k + i] * unit.step, y: unit.centre[j] + packed[3 * k + j] * unit.step, k };
}

/* Walls, feasible starts and goal, below the points. */
const scenery = {
  id: "scenery",
  beforeDatasetsDraw(chart, _, { view, behind, goal }) {
    if (!view) return;
    const { ctx, chartArea: area, scales: { x, y } } = chart;
    ctx.save();
    ctx.beginPath();
    ctx.rect(area.left, area.top, area.width, area.height);
    ctx.clip();
    const paths = view.outlines.map((outline) => {
      const path = new Path2D();
      for (const [a, b] of outline) path.lineTo(x.getPixelForValue(a), y.getPixelForValue(b));
      path.closePath();
      return path;
    });
    /* Edges first: what is left of them is the outline of all walls together. */
    ctx.lineWidth = 2;
    ctx.strokeStyle = css("--wall-edge");
    for (const path of paths) ctx.stroke(path);
    ctx.fillStyle = css("--wall");
    for (const path of paths) ctx.fill(path);
    ctx.fillStyle = css("--behind");
    for (const point of behind) {
      ctx.fillRect(x.getPixelForValue(point.x) - 1, y.getPixelForValue(point.y) - 1, 2, 2);
    }
    ctx.restore();
  },
  afterDatasetsDraw(chart, _, { view, goal }) {
    if (!view) return;
    const { ctx, scales } = chart;
    const [a, b] = [scales.x.getPixelForValue(goal[view.axes[0]]), scales.y.getPixelForValue(goal[view.axes[1]])];
    ctx.save();
    ctx.lineCap = "round";
    for (const [width, colour] of [[5, css("--card")], [2.2, css("--marker")]]) {
      ctx.lineWidth = width;
      ctx.strokeStyle = colour;
      ctx.beginPath();
      ctx.moveTo(a - 7, b); ctx.lineTo(a + 7, b); ctx.moveTo(a, b - 7); ctx.lineTo(a, b + 7);
      ctx.stroke();
    }
    ctx.restore();
  },
};

/* One view of the starts. `kinds` are the classes of points; show(points by class) replaces what is shown. */
class View {
  constructor(parent, data, view, kinds, describe, radius = 3.4) {
    this.view = view;
    const [width, height] = [view.high[0] - view.low[0], view.high[1] - view.low[1]];
    const box = element("div", "view", parent);
    element("h3", "", box).textContent = view.title;
    const plan = element("div", "plan", box);
    plan.style.height = `calc((100cqw - ${AXIS_WIDTH + PADDING}px) * ${height / width} + ${AXIS_HEIGHT + PADDING}px)`;
    this.canvas = element("canvas", "", plan);
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", `starts, ${view.title}`);
    const feasible = unpack(data.feasible, Int16Array);
    const behind = [];
    for (let k = 0; k < feasible.length / 3; k++) {
      const point = place(feasible, k, view.axes, data.unit);
      if (point) behind.push(point);
    }
    const axis = (index) => ({
      type: "linear",
      min: view.low[index],
      max: view.high[index],
      title: { display: true, text: `${"xyz"[view.axes[index]]} [m]` },
      grid: { color: () => css("--track") },
      ticks: { maxTicksLimit: 7, includeBounds: false, maxRotation: 0, callback: (value) => Number(value.toPrecision(4)) },
      /* A fixed size, so that both directions have the same scale. */
      afterFit: (scale) => { if (index) scale.width = AXIS_WIDTH; else scale.height = AXIS_HEIGHT; },
    });
    this.chart = new Chart(this.canvas, {
      type: "scatter",
      data: {
        datasets: kinds.map(({ name, colour }) => ({
          label: name, data: [], pointRadius: ({ chart }) => (chart.width < 420 ? 0.7 : 1) * radius, pointHoverRadius: 6, borderWidth: 0,
          pointBackgroundColor: () => css(colour) + "d0", pointHoverBackgroundColor: () => css(colour),
        })),
      },
      options: {
        responsive: true, maintainAspectRatio: false, animation: false,
        layout: { padding: { top: PADDING, right: PADDING, left: 0, bottom: 0 }, autoPadding: false },
        scales: { x: axis(0), y: axis(1) },
        interaction: { mode: "nearest", intersect: true },
        plugins: {
          legend: { display: false },
          scenery: { view, behind, goal: data.goal },
          tooltip: {
            displayColors: true,
            callbacks: {
              label: (item) => `${item.dataset.label}${describe(item.raw.k)}`,
              afterLabel: (item) => `${["x", "y"].map((a, n) =>
                `${"xyz"[view.axes[n]]} ${item.raw[a].toFixed(3)}`).join(", ")} m`,
            },
          },
        },
      },
      plugins: [scenery],
    });
  }

  zoom({ low, high }) {
    const { x, y } = this.chart.options.scales;
    [x.min, y.min] = low;
    [x.max, y.max] = high;
    this.chart.update("none");
  }

  show(classes) {
    /* What is rare lies on top of what is frequent. */
    const order = classes.map((points, k) => k).sort((a, b) => classes[a].length - classes[b].length);
    this.chart.data.datasets.forEach((dataset, k) => {
      dataset.data = classes[k];
      dataset.order = order.indexOf(k);
    });
    this.chart.update("none");
  }
}

/* The part of a view, of its own proportions, that holds points and goal; null where that is most of it. */
function closer(view, points, goal) {
  if (!points.length) return null;
  const low = [], high = [];
  for (const a of [0, 1]) {
    const values = Float64Array.from(points, (point) => (a ? point.y : point.x)).sort();
    const at = (share) => values[Math.round(share * (values.length - 1))];
    low.push(Math.min(at(0.01), goal[view.axes[a]]));
    high.push(Math.max(at(0.99), goal[view.axes[a]]));
  }
  const whole = [0, 1].map((a) => view.high[a] - view.low[a]);
  const share = 1.2 * Math.max(...[0, 1].map((a) => (high[a] - low[a]) / whole[a]), 0.02);
  if (share > 0.55) return null;
  const centre = [0, 1].map((a) => (low[a] + high[a]) / 2);
  return {
    low: centre.map((c, a) => c - (share * whole[a]) / 2),
    high: centre.map((c, a) => c + (share * whole[a]) / 2),
  };
}

/* Points of packed rows first..last-1, by class. */
function classify(packed, first, last, classOf, number, axes, unit) {
  const classes = Array.from({ length: number }, () => []);
  for (let k = first; k < last; k++) {
    const point = place(packed, k, axes, unit);
    if (point) classes[classOf(k)].push(point);
  }
  return classes;
}

/* The starts of each iteration, with a slider over them and a button that plays them. */
class Growth {
  constructor(parent, data, onMove) {
    this.data = data;
    this.onMove = onMove;
    this.points = unpack(data.points, Int16Array);
    this.kinds = unpack(data.kinds, Uint8Array);
    const [successes, episodes] = [unpack(data.successes, Uint16Array), unpack(data.episodes, Uint16Array)];
    const describe = (k) => `: goal reached in ${successes[k]} of ${episodes[k]} episodes`;
    this.first = [0];
    for (const number of data.number) this.first.push(this.first[this.first.length - 1] + number);
    const box = element("div", "views", parent);
    this.views = data.views.map((view) => new View(box, data, view, KINDS, describe));
    this.zoomButtons(parent);
    const player = element("div", "player", parent);
    this.button = element("button", "play", player);
    this.button.type = "button";
    this.slider = element("input", "", player);
    Object.assign(this.slider, { type: "range", min: 0, max: data.iterations.length - 1, step: 1, id: "iteration" });
    this.slider.setAttribute("aria-label", "iteration");
    this.output = element("output", "", player);
    this.key = element("div", "key", parent);
    this.slider.addEventListener("input", () => { this.stop(); this.move(Number(this.slider.value)); });
    this.button.addEventListener("click", () => (this.timer ? this.stop() : this.play()));
    this.stop();
    this.move(data.iterations.length - 1);
  }

  /* Where the starts fill little of what is feasible, they can be looked at closely. */
  zoomButtons(parent) {
    const total = this.first[this.first.length - 1];
    const every = Math.ceil(total / 2000); /* some of them show where they are */
    const parts = this.views.map(({ view }) => {
      const points = [];
      for (let k = 0; k < total; k += every) {
        const point = place(this.points, k, view.axes, this.data.unit);
        if (point) points.push(point);
      }
      return closer(view, points, this.data.goal);
    });
    if (parts.every((part) => part === null)) return;
    const box = element("div", "segments", element("div", "key", parent));
    box.setAttribute("role", "group");
    box.setAttribute("aria-label", "part shown");
    const buttons = ["all feasible starts", "closer"].map((text, near) => {
      const made = element("button", "", box, text);
      made.type = "button";
      made.addEventListener("click", () => {
        buttons.forEach((each, k) => each.setAttribute("aria-pressed", k === near));
        this.views.forEach((view, k) => view.zoom((near && parts[k]) || view.view));
      });
      made.setAttribute("aria-pressed", near === 0);
      return made;
    });
  }

  get iteration() { return this.data.iterations[this.frame]; }

  move(frame) {
    this.frame = frame;
    this.slider.value = frame;
    const [first, last] = [this.first[frame], this.first[frame + 1]];
    for (const view of this.views) {
      view.show(classify(this.points, first, last, (k) => this.kinds[k], KINDS.length, view.view.axes, this.data.unit));
    }
    const counts = KINDS.map(() => 0);
    for (let k = first; k < last; k++) counts[this.kinds[k]]++;
    drawKey(this.key, KINDS, counts);
    this.output.textContent = `iteration ${this.iteration}`;
    this.slider.setAttribute("aria-valuetext", this.output.textContent);
    this.onMove(this.iteration);
  }

  moveTo(iteration) {
    const distance = this.data.iterations.map((each) => Math.abs(each - iteration));
    this.stop();
    this.move(distance.indexOf(Math.min(...distance)));
  }

  play() {
    const last = this.data.iterations.length - 1;
    if (this.frame >= last) this.move(0);
    this.draw("M4 2h4v14H4zM10 2h4v14h-4z", "pause");
    /* Twelve seconds for all, but not so slow or fast that nothing is seen. */
    const pause = Math.max(40, Math.min(500, 12000 / (last + 1)));
    this.timer = setInterval(() => {
      if (this.frame >= last) this.stop();
      else this.move(this.frame + 1);
    }, pause);
  }

  stop() {
    clearInterval(this.timer);
    this.timer = null;
    this.draw("M4 1.5v15l13-7.5z", "play");
  }

  draw(path, label) {
    this.button.innerHTML = `<svg viewBox="0 0 18 18" aria-hidden="true"><path d="${path}"/></svg>`;
    this.button.setAttribute("aria-label", label);
    this.button.title = label;
  }
}

function drawKey(parent, kinds, counts) {
  parent.replaceChildren();
  kinds.forEach(({ name, colour }, k) => {
    const entry = element("span", "", parent);
    element("i", "dot", entry).style.background = `var(${colour})`;
    entry.append(`${name} ${counts[k]}`);
  });
}
