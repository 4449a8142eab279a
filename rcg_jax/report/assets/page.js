"use strict";
/* The page, from the data in it. Text of the data only ever becomes text. */

const DATA = JSON.parse(document.getElementById("data").textContent);
const METHODS = ["reverse", "all_starts", "uniform", "oracle", "self_play"];
const OTHERS = ["--g0", "--g1", "--g2", "--g3", "--g4", "--g5", "--g6", "--g7"];
const AXES = {
  env_steps: { button: "steps", title: "environment steps [million]", scale: 1e-6 },
  wall_s: { button: "time", title: "wall-clock time [min]", scale: 1 / 60 },
  iteration: { button: "iterations", title: "iteration", scale: 1 },
};
const comparison = DATA.kind === "comparison";
let axis = "env_steps";
const charts = []; /* functions that give a chart its data anew, after a change of the axis */
let growth = null;

function element(name, className, parent, text) {
  const made = document.createElement(name);
  if (className) made.className = className;
  if (text !== undefined) made.textContent = text;
  if (parent) parent.append(made);
  return made;
}

/* Names and paths may be broken after their parts. */
function code(parent, text) {
  const made = element("code", "", parent);
  text.split(/(?<=[._/,])/).forEach((part, k) => made.append(...(k ? [document.createElement("wbr"), part] : [part])));
  return made;
}

function section(title, note) {
  const made = element("section", "", document.getElementById("main"));
  const top = element("div", "top", made);
  element("h2", "", top, title);
  if (note) element("p", "soft", made, note);
  return { made, top };
}

/* What lies below the first screen is drawn after the page has appeared. */
const waiting = [];
function later(draw) {
  waiting.push(draw);
}

function drawWaiting() {
  const draw = waiting.shift();
  if (draw) draw();
  if (waiting.length) setTimeout(drawWaiting);
  else document.documentElement.dataset.ready = "true";
}

function short(value) {
  if (value === null || value === undefined) return "–";
  if (value !== 0 && Math.abs(value) < 1e-3) return value.toExponential(1);
  return Math.abs(value) >= 1000 ? Math.round(value).toLocaleString("en") : String(Number(value.toPrecision(3)));
}

/* A share in percent, with one decimal where it is needed: only none and all are 0 % and 100 %. */
function percent(share) {
  const rounded = Number((share * 100).toFixed(1));
  if (rounded === 100 && share < 1) return "> 99.9 %";
  if (rounded === 0 && share > 0) return "< 0.1 %";
  return `${rounded} %`;
}

/* Colour and dashes of each group: the first one of a method has the method's, further ones have others. */
function groupStyles() {
  const taken = new Set();
  let other = 0;
  return DATA.runs.map(({ method }) => {
    if (METHODS.includes(method) && !taken.has(method)) {
      taken.add(method);
      return { colour: `--${method}`, dash: [] };
    }
    const k = other++;
    return { colour: OTHERS[k % OTHERS.length], dash: k >= OTHERS.length ? [6, 4] : [] };
  });
}
const STYLES = DATA.kind === "comparison" ? groupStyles() : [];

/* Values of a column at rows that have one, over the chosen axis. Evaluations have no clock: it is read off. */
function curve(run, table, name) {
  const columns = run[table], values = columns[name];
  if (!values) return [];
  const points = [];
  values.forEach((y, k) => {
    const x = abscissa(run, table, k);
    if (y !== null && x !== null) points.push({ x: x * AXES[axis].scale, y, k });
  });
  return points;
}

function abscissa(run, table, k) {
  const own = run[table][axis];
  if (own) return own[k];
  const { iteration, wall_s: clock } = run.metrics, wanted = run[table].iteration[k];
  let row = iteration.findIndex((each) => each >= wanted);
  if (row < 0) row = iteration.length - 1;
  return clock[row];
}

/* A vertical line at the iteration whose starts are shown. */
const marker = {
  id: "marker",
  afterDatasetsDraw(chart) {
    if (!growth || comparison) return;
    const { metrics } = DATA.runs[0];
    const row = metrics.iteration.findIndex((each) => each >= growth.iteration);
    const x = chart.scales.x.getPixelForValue(metrics[axis][row < 0 ? metrics.iteration.length - 1 : row] * AXES[axis].scale);
    const { ctx, chartArea: area } = chart;
    ctx.save();
    ctx.strokeStyle = css("--marker");
    ctx.globalAlpha = 0.5;
    ctx.setLineDash([3, 3]);
    ctx.beginPath();
    ctx.moveTo(x, area.top);
    ctx.lineTo(x, area.bottom);
    ctx.stroke();
    ctx.restore();
  },
};

/* A chart of lines over the axis. `lines` are {run, table, name, label, colour, ...}; bands come with `low` and `high`. */
function lineChart(parent, lines, { low = false, unit = "", top, stacked = false, legend = true, marked = false, title = "" } = {}) {
  const box = element("div", low ? "chart low" : "chart", parent);
  const canvas = element("canvas", "", box);
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", title);
  const datasets = [];
  for (const line of lines) {
    const paint = () => css(line.colour);
    if (line.low) {
      for (const [end, fill] of [["low", false], ["high", "-1"]]) {
        datasets.push({
          line: { ...line, name: line[end], band: true }, label: "", fill, pointRadius: 0, pointHitRadius: 0,
          borderWidth: 0, backgroundColor: () => css(line.colour) + "2c", order: 2,
        });
      }
    }
    datasets.push({
      line, label: line.label, borderColor: paint, backgroundColor: stacked ? () => css(line.colour) + "cc" : paint,
      borderWidth: stacked ? 0 : line.width || 2, borderDash: line.dash || [], fill: stacked ? "stack" : false,
      pointRadius: line.points ? 2.6 : 0, pointHoverRadius: stacked ? 0 : 4, pointHitRadius: 8, order: line.order || 1,
      tension: 0,
    });
  }
  const single = lines[0].run.metrics.iteration.length === 1;
  if (single) datasets.forEach((each) => { if (!each.line.band) each.pointRadius = 3; });
  const chart = new Chart(canvas, {
    type: "line",
    data: { datasets },
    options: {
      responsive: true, maintainAspectRatio: false, animation: false, normalized: true, clip: 6,
      interaction: { mode: "nearest", axis: "x", intersect: false },
      onClick: (event, items) => {
        const item = items.find(({ datasetIndex }) => datasets[datasetIndex].line.table === "metrics");
        if (growth && item) growth.moveTo(DATA.runs[0].metrics.iteration[datasets[item.datasetIndex].data[item.index].k]);
      },
      scales: {
        x: {
          type: "linear", title: { display: !low || stacked, text: AXES[axis].title }, min: 0,
          grid: { display: false }, ticks: { maxRotation: 0, maxTicksLimit: low && !stacked ? 5 : 9 },
        },
        y: {
          min: unit === "" && top ? 0 : undefined, max: top, beginAtZero: true, stacked, title: { display: !!unit && !low, text: unit },
          grid: { color: () => css("--track") }, border: { display: false },
          ticks: { maxTicksLimit: low ? 4 : 6, callback: (value) => short(value) },
        },
      },
      plugins: {
        legend: {
          display: legend, position: "bottom",
          labels: {
            usePointStyle: true, boxHeight: 7, filter: (item) => item.text !== "",
            sort: (a, b) => a.datasetIndex - b.datasetIndex,
          },
          onClick: (event, item) => {
            const { line } = datasets[item.datasetIndex], hide = chart.isDatasetVisible(item.datasetIndex);
            datasets.forEach((each, k) => { if (each.line.label === line.label) chart.setDatasetVisibility(k, !hide); });
            chart.update();
          },
        },
        tooltip: {
          filter: (item) => !item.dataset.line.band,
          itemSort: (a, b) => (stacked ? b.datasetIndex - a.datasetIndex : a.datasetIndex - b.datasetIndex),
          callbacks: { title: tooltipTitle, label: tooltipLabel, footer: tooltipFooter, labelColor: tooltipColour },
        },
      },
    },
    plugins: marked ? [marker] : [],
  });
  const fill = () => {
    for (const dataset of datasets) dataset.data = curve(dataset.line.run, dataset.line.table, dataset.line.name);
    const ends = datasets.map(({ data }) => (data.length ? data[data.length - 1].x : 0));
    chart.options.scales.x.max = Math.max(...ends, single ? 2 * AXES[axis].scale : 0);
    chart.options.scales.x.title.text = AXES[axis].title;
    chart.update("none");
  };
  charts.push({ fill, chart, marked });
  fill();
  return chart;
}

function tooltipTitle(items) {
  if (!items.length) return "";
  const { line } = items[0].dataset, columns = line.run[line.table], { k } = items[0].raw;
  const steps = `${short(columns.env_steps[k] / 1e6)} M steps`;
  const clock = axis === "wall_s" ? `, ${short(items[0].raw.x)} min` : "";
  return `iteration ${Math.round(columns.iteration[k])}, ${steps}${clock}`;
}

function tooltipLabel(item) {
  const { line } = item.dataset, { k, y } = item.raw, columns = line.run[line.table];
  const unit = line.unit ? ` ${line.unit}` : "";
  const band = line.low ? ` [${short(columns[line.low][k])}, ${short(columns[line.high][k])}]` : "";
  return `${line.label}: ${short(y)}${unit}${band}`;
}

/* Between two evaluations: what the one before found. */
function tooltipFooter(items) {
  if (comparison || !items.length || items.some(({ dataset }) => dataset.line.table === "evaluations")) return "";
  const { line } = items[0].dataset, { run } = line, found = run.evaluations.iteration;
  if (line.name !== "success" || !found) return "";
  const now = run.metrics.iteration[items[0].raw.k];
  const before = found.findLastIndex((each) => each <= now);
  if (before < 0) return "";
  const [rate, low, high] = ["", "_low", "_high"].map((end) => short(run.evaluations[`success_stochastic${end}`][before]));
  return `all feasible starts at iteration ${found[before]}: ${rate} [${low}, ${high}]`;
}

function tooltipColour(item) {
  const colour = css(item.dataset.line.colour);
  return { borderColor: colour, backgroundColor: colour };
}

function axisButtons(parent) {
  const box = element("div", "segments", parent);
  box.setAttribute("role", "group");
  box.setAttribute("aria-label", "horizontal axis");
  for (const [name, { button }] of Object.entries(AXES)) {
    const made = element("button", "", box, button);
    made.type = "button";
    made.setAttribute("aria-pressed", name === axis);
    made.addEventListener("click", () => {
      axis = name;
      for (const each of box.children) each.setAttribute("aria-pressed", each === made);
      charts.forEach(({ fill }) => fill());
    });
  }
}

function head() {
  const header = element("header", "", document.getElementById("main"));
  element("div", "name", header, DATA.title);
  element("h1", "", header, DATA.headline.replaceAll(" %", "\u00a0%"));
  element("p", "soft", header, DATA.detail);
  const changed = DATA.settings ? DATA.settings.changed.filter(({ told }) => told) : [];
  if (changed.length) {
    const chips = element("div", "chips", header);
    element("span", "soft", chips, "not by default:");
    for (const { name, value, default: usual, help } of changed) {
      element("span", "chip", chips, `${name}=${value}`).title = `${help}; default: ${usual}`;
    }
  }
  for (const line of DATA.left_out) element("p", "soft left-out", header, line);
}

function successOfRun() {
  const run = DATA.runs[0];
  const { made, top } = section("Success");
  axisButtons(top);
  lineChart(made, [
    { run, table: "evaluations", name: "success_stochastic", low: "success_stochastic_low", high: "success_stochastic_high",
      label: "all feasible starts ρ₀, stochastic policy", colour: "--rho0", width: 2.6, points: true },
    { run, table: "evaluations", name: "success_mean", low: "success_mean_low", high: "success_mean_high",
      label: "ρ₀, mean action", colour: "--mean", dash: [5, 4], points: true },
    { run, table: "metrics", name: "success", label: "training starts ρᵢ", colour: "--train", width: 1.3, order: 3 },
  ], { top: 1, marked: true, title: "success over training" });
  element("p", "soft", made, "Share of the episodes that reach the goal. Shaded: 95 % Wilson intervals. Tap or hover for values.");
}

function successOfRuns() {
  const { made, top } = section("Success on all feasible starts, ρ₀");
  axisButtons(top);
  const lines = (table, name, band) => DATA.runs.map((run, k) => ({
    run, table, name, label: run.label, ...STYLES[k], points: table === "evaluations", width: 2.4,
    ...(band && run[table][`${name}_low`] ? { low: `${name}_low`, high: `${name}_high` } : {}),
  }));
  lineChart(made, lines("evaluations", "success_stochastic", true), { top: 1, title: "success on rho_0 of each group" });
  table();
  if (DATA.differences.names.length) differences();
  const other = section("Success on their own training starts, ρᵢ");
  lineChart(other.made, lines("metrics", "success", true), { top: 1, title: "success on rho_i of each group" });
  if (DATA.runs.some((run) => run.metrics.share_good)) {
    const share = section("Share of good starts");
    lineChart(share.made, lines("metrics", "share_good", false), { top: 1, title: "share of good starts of each group" });
  }
}

function growthSection() {
  const run = DATA.runs[0];
  const point = DATA.starts && DATA.starts.name ? `Each dot is a start: it is drawn where ${DATA.starts.name} is.` : "Each dot is a start.";
  const { made } = section("How the starts grew", DATA.starts
    ? `${point} Pale violet: feasible starts ρ₀, for comparison. Cross: the goal.` : undefined);
  if (DATA.starts) growth = new Growth(made, DATA.starts, () => charts.forEach(({ chart, marked }) => { if (marked) chart.render(); }));
  if (!run.metrics.share_good) return;
  const share = element("div", "", made);
  share.style.marginTop = "14px";
  element("h3", "", share, "Share of the labelled starts of each iteration");
  const bounds = DATA.starts ? DATA.starts.thresholds : null;
  const kinds = [["share_high", "mastered", "--high"], ["share_good", "good", "--good"], ["share_low", "too hard", "--low"]];
  lineChart(share, kinds.map(([name, label, colour]) => ({ run, table: "metrics", name, label, colour })),
    { low: true, stacked: true, top: 1, marked: true, title: "share of good starts" });
  if (bounds) {
    element("p", "soft", share,
      `Good: between ${percent(bounds[0])} and ${percent(bounds[1])} of the episodes from there reach the goal. Tap the chart to see an iteration's starts.`);
  }
}

/* A table of rates, each with a bar and its interval. */
function rates(parent, heading, rows) {
  element("h3", "", parent, heading);
  const body = element("tbody", "", element("table", "rates", parent));
  for (const { label, rate, low, high, successes, episodes, colour } of rows) {
    const row = element("tr", "", body);
    element("td", "", row, label);
    const bar = element("div", "bar", element("td", "", row));
    const fill = element("i", "", bar);
    fill.style.width = `${rate * 100}%`;
    if (colour) fill.style.background = `var(${colour})`;
    const whisker = element("b", "", bar);
    Object.assign(whisker.style, { left: `${low * 100}%`, width: `${(high - low) * 100}%` });
    bar.title = `${successes.toLocaleString("en")} of ${episodes.toLocaleString("en")}, 95 % interval ${low.toFixed(3)} to ${high.toFixed(3)}`;
    const cell = element("td", "", row, percent(rate));
    element("span", "help", cell, ` (${successes.toLocaleString("en")} of ${episodes.toLocaleString("en")})`);
  }
}

function finalSection() {
  const { final, starts } = DATA;
  if (!final) return;
  const mean = final.steps === null ? "" : ` A success takes ${short(final.steps)} steps on average.`;
  const { made } = section("Where the final policy reaches the goal",
    `${final.all.successes.toLocaleString("en")} of ${final.all.episodes.toLocaleString("en")} episodes from feasible starts after iteration ${final.iteration}, stochastic policy.${mean} Lines: 95 % intervals.${starts && starts.name && starts.finals ? ` Each dot: where ${starts.name} is at the start.` : ""}`);
  const columns = element("div", "two", made);
  const left = starts && starts.finals ? element("div", "", columns) : null;
  const right = element("div", "", columns);
  rates(right, "By distance of the start to the goal (straight line)", final.distance);
  if (final.region.length) {
    const rest = element("div", "", right);
    rest.style.marginTop = "16px";
    rates(rest, "By region of the task", final.region);
  }
  if (!left) return;
  const points = unpack(starts.finals.points, Int16Array), reached = unpack(starts.finals.reached, Uint8Array);
  const views = element("div", "views", left);
  const quiet = { ...starts, feasible: "" };
  for (const one of starts.views) {
    later(() => {
      const view = new View(views, quiet, one, OUTCOMES, () => "", 2.6);
      view.show(classify(points, 0, reached.length, (k) => reached[k], 2, one.axes, starts.unit));
    });
  }
  const good = reached.reduce((sum, each) => sum + each, 0);
  drawKey(element("div", "key", left), OUTCOMES, [reached.length - good, good]);
}

function robustnessSection() {
  if (!DATA.robustness.length) return;
  const { made } = section("In a changed world",
    "Success on ρ₀ under one perturbation at a time, from the same starts, stochastic policy: the newest evaluation with perturb=. Lines: 95 % intervals.");
  const grid = element("div", "grid", made);
  for (const { title, rows } of DATA.robustness) rates(element("div", "", grid), title, rows);
}

function videoSection() {
  if (!DATA.videos.length) return;
  const { made } = section("The policy at work");
  const columns = element("div", "two", made);
  for (const { title, source, caption } of DATA.videos) {
    const figure = element("figure", "", columns);
    element("h3", "", figure, title);
    const video = element("video", "", figure);
    Object.assign(video, { controls: true, muted: true, loop: true, playsInline: true, preload: "metadata", src: source });
    video.setAttribute("aria-label", `${title}: ${caption}`);
    element("figcaption", "", figure, caption);
  }
}

function smallCurves() {
  if (!DATA.small.length) return;
  const { made } = section("Other curves");
  const grid = element("div", "grid", made);
  for (const { name, title, unit } of DATA.small) {
    const runs = DATA.runs.filter((run) => run.metrics[name] && run.metrics[name].some((value) => value !== null));
    if (!runs.length) continue;
    const box = element("div", "", grid);
    element("h3", "", box, unit ? `${title} [${unit}]` : title);
    const lines = runs.map((run) => ({
      run, table: "metrics", name, label: comparison ? run.label : title, unit, width: 1.6,
      ...(comparison ? STYLES[DATA.runs.indexOf(run)] : { colour: "--ink" }),
    }));
    const space = element("div", "chart low", box);
    later(() => {
      space.remove();
      lineChart(box, lines, { low: true, unit, legend: false, title });
    });
  }
}

function table() {
  const { made } = section("Final success on ρ₀", "Stochastic policy. With several seeds: mean ± standard deviation over the seeds. In brackets: the 95 % Wilson interval of one seed.");
  const body = element("table", "stack", element("div", "scroll", made));
  const names = element("tr", "", element("thead", "", body));
  const columns = ["", "success", "each seed", "mean action", "steps", "time"];
  for (const name of columns) element("th", "", names, name);
  const rows = element("tbody", "", body);
  DATA.table.forEach((entry, k) => {
    const row = element("tr", "", rows);
    const label = element("span", "label", element("td", "", row));
    const dot = element("i", "dot", label);
    dot.style.background = `var(${STYLES[k].colour})`;
    element("span", "", label, entry.label);
    const spread = entry.deviation === null ? interval(entry) : ` ± ${entry.deviation.toFixed(3)}`;
    const success = element("span", "", element("td", "", row), entry.mean === null ? "not evaluated" : `${entry.mean.toFixed(3)}${spread}`);
    if (entry.unfinished) element("div", "help", success, entry.unfinished);
    element("td", "", row, entry.seeds.length > 1 ? entry.rates.map((rate) => rate.toFixed(3)).join(", ") : `seed ${entry.seeds[0]}`);
    element("td", "", row, entry.mean_action === null ? "–" : entry.mean_action.toFixed(3));
    element("td", "", row, entry.steps);
    element("td", "", row, entry.time);
    [...row.children].forEach((cell, n) => { cell.dataset.name = columns[n]; });
  });
}

function interval(entry) {
  if (!entry.intervals.length) return "";
  const [low, high] = entry.intervals[0];
  return ` [${low.toFixed(3)}, ${high.toFixed(3)}]`;
}

function differences() {
  const { names, rows } = DATA.differences;
  const { made } = section("Settings that differ");
  const body = element("table", "stack", element("div", "scroll", made));
  const top = element("tr", "", element("thead", "", body));
  for (const name of ["", ...names]) element("th", "", top, name);
  const list = element("tbody", "", body);
  for (const row of rows) {
    const line = element("tr", "", list);
    row.forEach((value, k) => {
      const cell = element("td", "", line);
      cell.dataset.name = ["", ...names][k];
      if (k) code(cell, value);
      else cell.textContent = value;
    });
  }
}

function settingsSection() {
  const { made } = section("Settings and provenance");
  for (const [key, title] of DATA.settings ? [["changed", "Different from the defaults"], ["rest", "Defaults"]] : []) {
    const entries = DATA.settings[key];
    if (!entries.length) continue;
    const box = element("details", "", made);
    box.open = key === "changed";
    element("summary", "", box, `${title} (${entries.length})`);
    const body = element("table", "settings", box);
    const top = element("tr", "", element("thead", "", body));
    for (const name of key === "changed" ? ["setting", "value", "default", "meaning"] : ["setting", "value", "", "meaning"]) element("th", "", top, name);
    const rows = element("tbody", "", body);
    for (const { name, value, default: usual, help } of entries) {
      const row = element("tr", "", rows);
      for (const text of [name, value, key === "changed" ? usual : ""]) code(element("td", "", row), text);
      element("td", "help", row, help);
    }
  }
  const body = element("tbody", "", element("table", "", made));
  for (const [name, value] of DATA.about) {
    const row = element("tr", "", body);
    element("td", "help", row, name);
    element("td", "about", row, value);
  }
}

function colours() {
  Chart.defaults.color = css("--soft");
  Chart.defaults.borderColor = css("--line");
  Chart.defaults.font.family = getComputedStyle(document.body).fontFamily;
  Chart.defaults.font.size = 13;
}

function restyle() {
  painted.clear();
  colours();
  for (const chart of Object.values(Chart.instances)) {
    chart.options.color = css("--soft");
    chart.update("none");
  }
}

colours();
head();
if (comparison) successOfRuns();
else {
  successOfRun();
  growthSection();
  finalSection();
  robustnessSection();
  videoSection();
}
smallCurves();
settingsSection();
setTimeout(drawWaiting);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", restyle);
