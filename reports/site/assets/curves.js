// Quality against seconds, and what the seconds are made of.

const WIDE = 720, HIGH = 360, LEFT = 62, RIGHT = 12, TOP = 12, BOTTOM = 44;

function curvesTab(group, g, of) {
  const runs = group.runs.map((k) => DATA.runs[k]).filter((run) => run.curve.length);
  const names = [...new Set(runs.flatMap((run) => run.curve.flatMap((p) => Object.keys(p.scores))))];
  const identity = names.includes(of.get("by")) ? of.get("by")
    : names.find((i) => regionOf(i) === group.headline) ?? names[0];
  return [
    names.length > 0 && el("section", {}, el("h3", {}, "Quality against seconds of fitting"),
      el("div", { class: "bar" }, choice("number", names.map((i) => [i, titled(i)]), identity, (v) => put({ by: v }))),
      chart(curveLines(runs, identity, group), { x: "seconds of fitting", y: axisTitle(identity), identity }),
      el("p", { class: "note" }, `Test views that the curves stand on: ${standing(runs)}; the table stands on all.`)),
    workPrecision(group, of),
    stageBars(group),
  ];
}

// Names of rows in the order of their colours: the table's, then those of runs that are not done.
function labelsOf(group) {
  return [...new Set([...group.rows.filter((row) => row.kind === "method").map((row) => row.label),
    ...group.runs.map((k) => DATA.runs[k].label)])];
}

function axisTitle(identity) {
  const metric = metricOf(identity);
  return `${titled(identity)}${metric.unit ? ` (${metric.unit})` : ""}`;
}

function standing(runs) {
  return [...new Set(runs.flatMap((run) => run.curve.map((p) => (p.of ? `${p.views} of ${p.of}` : "not recorded"))))].join(", ");
}

function curveLines(runs, identity, group) {
  const labels = labelsOf(group);
  const scale = metricOf(identity).scale;
  return runs.map((run) => ({
    name: `${run.label} on ${run.scene}, seed ${run.seed}`, label: run.label,
    colour: colourOf(Math.max(0, labels.indexOf(run.label))),
    points: run.curve.filter((p) => identity in p.scores && Number.isFinite(real(p.scores[identity])) && p.seconds > 0)
      .map((p) => ({ x: p.seconds, y: real(p.scores[identity]) * scale, value: p.scores[identity],
        words: `step ${p.step}, ${p.seconds.toPrecision(3)} s: ${shown(p.scores[identity], metricOf(identity))}` })),
  })).filter((line) => line.points.length);
}

// Every method's mean against its mean seconds; nothing on the dashed line is beaten in both.
function workPrecision(group, of) {
  const rows = group.rows.filter((row) => row.kind === "method" && row.fit > 0);
  const identities = group.identities.map((i) => i.name).filter((i) => rows.some((row) => Number.isFinite(real(row.means[i]))));
  if (rows.length < 2 || !identities.length) return null;
  const identity = identities.includes(of.get("wp")) ? of.get("wp")
    : identities.find((i) => regionOf(i) === group.headline) ?? identities[0];
  const metric = metricOf(identity);
  const sign = metric.higher ? 1 : -1;
  const points = rows.filter((row) => Number.isFinite(real(row.means[identity]))).map((row) => ({
    row, x: row.fit, y: real(row.means[identity]) * metric.scale, value: row.means[identity],
    words: `${seconds(row.fit)} s: ${shown(row.means[identity], metric)}`,
  }));
  const front = points.filter((p) => !points.some((q) => q !== p && q.x <= p.x && sign * q.y >= sign * p.y
    && (q.x < p.x || sign * q.y > sign * p.y))).sort((p, q) => p.x - q.x);
  const labels = labelsOf(group);
  const lines = points.map((p) => ({ name: p.row.label, label: p.row.label, colour: colourOf(labels.indexOf(p.row.label)),
    points: [p], dots: true }));
  const scenes = new Set(rows.map((row) => row.scenes.join(" "))).size > 1;
  return el("section", {}, el("h3", {}, "Work and precision"),
    el("div", { class: "bar" }, choice("number", identities.map((i) => [i, titled(i)]), identity, (v) => put({ wp: v }))),
    chart([...lines, { name: "Pareto set", label: "Pareto set", colour: "#888888", points: front, dashed: true, mute: true }],
      { x: "seconds of fitting, mean", y: axisTitle(identity), identity }),
    el("p", { class: "note" }, "Dashed: nothing is as fast and better. ",
      scenes && "Rows stand on different scenes: compare with care."));
}

function ticksLog(low, high) {
  if (high / low < 5) return ticksLinear(low, high);
  const ticks = [];
  for (let e = Math.floor(Math.log10(low)); e <= Math.ceil(Math.log10(high)); e++) {
    for (const m of [1, 2, 5]) if (m * 10 ** e >= low && m * 10 ** e <= high) ticks.push(m * 10 ** e);
  }
  return ticks;
}

function ticksLinear(low, high) {
  const rough = (high - low) / 5;
  const unit = 10 ** Math.floor(Math.log10(rough));
  const by = unit * [1, 2, 5, 10].find((m) => m * unit >= rough);
  const ticks = [];
  for (let k = Math.ceil(low / by); k * by <= high + 1e-12; k++) ticks.push(Number((k * by).toPrecision(10)));
  return ticks;
}

function chart(lines, { x, y }) {
  const every = lines.flatMap((line) => line.points);
  if (!every.length) return el("p", { class: "note" }, "No finite numbers to draw.");
  const span = (values, log) => {
    const [low, high] = [Math.min(...values), Math.max(...values)];
    if (log) return [low / 1.15, high * 1.15];
    const room = (high - low || Math.abs(high) || 1) * 0.08;
    return [low - room, high + room];
  };
  const [x0, x1] = span(every.map((p) => p.x), true);
  const [y0, y1] = span(every.map((p) => p.y), false);
  const px = (v) => LEFT + (WIDE - LEFT - RIGHT) * (Math.log(v / x0) / Math.log(x1 / x0));
  const py = (v) => HIGH - BOTTOM - (HIGH - TOP - BOTTOM) * ((v - y0) / (y1 - y0));
  const tip = el("output", { class: "tip" }, "Move over the curves, or give the drawing the focus and use the arrow keys.");
  const ring = svg("circle", { r: 6, class: "ring", visibility: "hidden" });
  const own = lines.filter((line) => !line.mute).flatMap((line) => line.points.map((p) => ({ ...p, line, px: px(p.x), py: py(p.y) })));
  let at = -1;
  const point = (k) => {
    at = (k + own.length) % own.length;
    const p = own[at];
    ring.setAttribute("cx", p.px);
    ring.setAttribute("cy", p.py);
    ring.setAttribute("visibility", "visible");
    tip.textContent = `${p.line.name}: ${p.words}`;
    tip.dataset.value = String(p.value);
  };
  const drawing = svg("svg", { viewBox: `0 0 ${WIDE} ${HIGH}`, role: "img", tabindex: "0", "aria-label": `${y} against ${x}`,
    onpointermove: (event) => {
      const box = drawing.getBoundingClientRect();
      const [mx, my] = [(event.clientX - box.left) / box.width * WIDE, (event.clientY - box.top) / box.height * HIGH];
      let best = 0;
      own.forEach((p, k) => { if (Math.hypot(p.px - mx, p.py - my) < Math.hypot(own[best].px - mx, own[best].py - my)) best = k; });
      point(best);
    },
    onkeydown: (event) => {
      if (event.key !== "ArrowRight" && event.key !== "ArrowLeft") return;
      event.preventDefault();
      event.stopPropagation();
      point(at + (event.key === "ArrowRight" ? 1 : -1));
    } },
  ticksLog(x0, x1).map((t) => [svg("line", { class: "grid", x1: px(t), x2: px(t), y1: TOP, y2: HIGH - BOTTOM }),
    svg("text", { x: px(t), y: HIGH - BOTTOM + 16, "text-anchor": "middle" }, String(Number(t.toPrecision(3))))]),
  ticksLinear(y0, y1).map((t) => [svg("line", { class: "grid", x1: LEFT, x2: WIDE - RIGHT, y1: py(t), y2: py(t) }),
    svg("text", { x: LEFT - 6, y: py(t) + 4, "text-anchor": "end" }, String(t))]),
  svg("text", { x: (LEFT + WIDE) / 2, y: HIGH - 6, "text-anchor": "middle" }, x),
  svg("text", { transform: `translate(14 ${(TOP + HIGH - BOTTOM) / 2}) rotate(-90)`, "text-anchor": "middle" }, y),
  lines.map((line) => [
    !line.dots && svg("polyline", { points: line.points.map((p) => `${px(p.x)},${py(p.y)}`).join(" "), fill: "none",
      stroke: line.colour, "stroke-width": 1.8, "stroke-dasharray": line.dashed ? "6 4" : null }),
    !line.dashed && line.points.map((p) => svg("circle", { cx: px(p.x), cy: py(p.y), r: line.dots ? 6 : 3, fill: line.colour }))]),
  ring);
  const legend = new Map(lines.map((line) => [line.label, line.colour]));
  return el("div", { class: "chart" }, drawing, tip, el("ul", { class: "legend" }, [...legend].map(([name, colour]) =>
    el("li", {}, swatch(colour), name))));
}

function swatch(colour) {
  return svg("svg", { viewBox: "0 0 10 10", class: "swatch", "aria-hidden": "true" },
    svg("rect", { width: 10, height: 10, fill: colour }));
}

// One bar a row of the table: mean seconds of its stages; stages inside another are parts of it and are listed below.
function stageBars(group) {
  const rows = group.rows.filter((row) => row.kind === "method").map((row) => {
    const runs = row.runs.map((k) => DATA.runs[k]).filter((run) => run.stages.length);
    const totals = new Map();
    for (const run of runs) for (const [path, s] of run.stages) totals.set(path, (totals.get(path) ?? 0) + s / runs.length);
    const wall = runs.reduce((sum, run) => sum + run.wall / runs.length, 0);
    return { label: row.label, totals, wall };
  }).filter((row) => row.wall > 0);
  if (!rows.length) return null;
  const longest = Math.max(...rows.map((row) => row.wall));
  // leaves of the tree of stages: they add up without counting anything twice
  const leaves = (totals) => {
    const parts = [];
    for (const [path, s] of totals) {
      const inner = [...totals].filter(([other]) => other.startsWith(`${path}/`) && !other.slice(path.length + 1).includes("/"));
      const rest = s - inner.reduce((sum, [, t]) => sum + t, 0);
      if (rest > 0) parts.push([inner.length ? `${path} (rest)` : path, rest]);
    }
    return parts;
  };
  const names = [...new Set(rows.flatMap((row) => leaves(row.totals).sort((p, q) => q[1] - p[1]).map(([path]) => path)))];
  const H = 30;
  return el("section", {}, el("h3", {}, "What the seconds are made of"),
    el("div", { class: "chart" }, rows.map((row) => {
      let x = 0;
      const parts = [...leaves(row.totals).sort((p, q) => q[1] - p[1]), ["in no stage", Math.max(0, row.wall - leaves(row.totals).reduce((s, p) => s + p[1], 0))]];
      return el("figure", { class: "bars" }, el("figcaption", {}, `${row.label}: ${row.wall.toFixed(0)} s`),
        svg("svg", { viewBox: `0 0 ${WIDE} ${H}`, role: "img", "aria-label": `stages of ${row.label}` }, parts.map(([path, s]) => {
          const width = s / longest * WIDE;
          const k = names.indexOf(path);
          const part = svg("g", {}, svg("title", {}, `${path}: ${s.toFixed(2)} s (${(100 * s / row.wall).toFixed(1)}%)`),
            svg("rect", { x, y: 2, width: Math.max(0, width - 0.6), height: H - 4, fill: k < 0 ? "#bbbbbb" : colourOf(k), opacity: k < COLOURS.length ? 1 : 0.55 }),
            width > 90 && svg("text", { x: x + 5, y: 19, class: "inbar" }, path.split("/").at(-1).slice(0, Math.floor(width / 8))));
          x += width;
          return part;
        })),
        el("details", {}, el("summary", {}, "all stages"), el("table", {}, [...row.totals].map(([path, s]) => el("tr", {},
          el("th", { scope: "row" }, "· ".repeat(path.split("/").length - 1) + path.split("/").at(-1)),
          el("td", {}, s.toFixed(2)), el("td", {}, `${(100 * s / row.wall).toFixed(1)}%`))))));
    })));
}
