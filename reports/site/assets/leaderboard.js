// The table of a group: rows by method, sortable; every number leads to the test views that it is the mean of.

const board = { metrics: null, regions: null, sort: null, down: true, open: null, shared: true };

// Means over the scenes that every method has, where they have others and unless all of each one's own are asked for.
function limited(group) {
  return board.shared && group.common?.length > 0;
}
function meansOf(group, row) {
  return limited(group) ? row.common : row.means;
}

function leaderboardTab(group) {
  const metrics = [...new Set(group.identities.map((i) => i.metric))];
  const regions = [...new Set(group.identities.map((i) => i.region))];
  if (!group.identities.length) return [el("p", {}, "No run of this group is done."), unfinished(group)];
  board.metrics ??= new Set(metrics);
  const first = regions.filter((r) => [group.headline, "hidden"].includes(r));
  board.regions ??= new Set(first.length ? first : regions);
  const columns = group.identities.filter((i) => board.metrics.has(i.metric) && board.regions.has(i.region));
  const chips = (names, chosen, kind) => el("div", { class: "chips", role: "group", "aria-label": kind },
    names.map((name) => toggle(kind === "metrics" ? DATA.metrics[name].title : name.replace("_", " "), chosen.has(name), (on) => {
      on ? chosen.add(name) : chosen.delete(name);
      show();
    })));
  return [
    el("div", { class: "bar" }, chips(metrics, board.metrics, "metrics"), chips(regions, board.regions, "regions"),
      el("div", { class: "chips" }, ["CSV", "Markdown", "LaTeX"].map((form) =>
        button(`copy ${form}`, (event) => copied(asText(group, columns, form), event.target), { class: "quiet" })))),
    group.common && el("p", { class: "note warning" }, group.common.length
      ? `The methods have other scenes. ${board.shared ? "Compared" : "Could be compared"} over what all have: ${group.common.join(", ")}. `
      : "No scene has every method: each mean is over its own scenes, and they do not compare. ",
      group.common.length > 0 && toggle("only scenes that all have", board.shared, (on) => { board.shared = on; show(); })),
    el("div", { class: "wide" }, boardTable(group, columns)),
    el("p", { class: "note" },
      "Mean over test views of a scene, then over scenes; of seconds, over the seeds of a scene, then over scenes; peak "
      + `MB is the largest. Headline region: ${group.headline}. Brackets: 95% interval over scenes. Bold is best, `
      + "underlined second, only where the intervals allow it. Grey rows bound every "
      + "method from above and below. A number opens the test views behind it."),
    Object.entries(group.absent).length > 0 && el("details", {}, el("summary", {}, "Absent numbers"),
      el("ul", {}, Object.entries(group.absent).map(([name, why]) => el("li", {}, el("code", {}, name), `: ${why}`)))),
    unstable(group),
    unfinished(group),
    board.open && drill(group),
  ];
}

function sortedRows(group) {
  if (board.sort === null) return group.rows;
  const key = (row) => {
    const value = board.sort in row ? row[board.sort] : meansOf(group, row)[board.sort];
    return board.sort === "label" ? row.label : real(value);
  };
  const sign = board.down ? -1 : 1;
  const order = (a, b) => {
    const [x, y] = [key(a), key(b)];
    if (typeof x === "string") return sign * x.localeCompare(y);
    if (Number.isNaN(x) || Number.isNaN(y)) return Number.isNaN(x) - Number.isNaN(y); // absent ones last
    return x === y ? 0 : sign * (x < y ? -1 : 1);
  };
  const own = group.rows.filter((row) => row.kind !== "bound");
  return [...own.sort(order), ...group.rows.filter((row) => row.kind === "bound")];
}

function boardTable(group, columns) {
  const sorter = (key, words, betterDown) => {
    const on = board.sort === key;
    const direction = on ? (board.down ? "descending" : "ascending") : "none";
    return el("th", { scope: "col", "aria-sort": direction },
      button(words, () => {
        board.down = on ? !board.down : betterDown;
        board.sort = key;
        show();
      }, { class: "sorter", title: key }));
  };
  const head = el("tr", {}, sorter("label", "method", false), el("th", { scope: "col" }, "scenes"),
    columns.map((i) => sorter(i.name, titled(i.name), DATA.metrics[i.metric].higher)),
    sorter("fit", "fit s", false), sorter("cpu", "fit CPU s", false), sorter("total", "total s", false), sorter("peak", "peak MB", false));
  const body = sortedRows(group).map((row) => el("tr", { class: row.kind },
    el("th", { scope: "row", title: row.about ?? "" }, row.label,
      row.seeds.length > 1 && el("small", {}, ` ${row.seeds.length} seeds`)),
    el("td", { title: scenesOf(group, row).join(", ") }, String(scenesOf(group, row).length)),
    columns.map((i) => scoreCell(group, row, i)),
    el("td", {}, row.kind === "method" ? seconds(row.fit) : ""),
    el("td", {}, row.kind === "method" ? seconds(row.cpu) : ""),
    el("td", {}, row.kind === "method" ? seconds(row.total) : ""),
    el("td", {}, row.kind === "method" ? row.peak.toFixed(0) : "")));
  return el("table", { class: "board" }, el("thead", {}, head), el("tbody", {}, body));
}

function scenesOf(group, row) {
  return limited(group) ? row.scenes.filter((scene) => group.common.includes(scene)) : row.scenes;
}

function scoreCell(group, row, identity) {
  const value = meansOf(group, row)[identity.name];
  const metric = DATA.metrics[identity.metric];
  const text = value === undefined ? "—" : shown(value, metric);
  const interval = (limited(group) ? row.common_intervals : row.intervals)[identity.name];
  const about = `${identity.name} = ${value ?? "absent"}`;
  const inner = [el("span", { class: row.marks[identity.name] ?? "" }, text),
    interval && interval[0] < interval[1] && el("small", {}, ` [${interval.map((v) => shown(v, metric)).join(", ")}]`)];
  if (row.kind === "bound" || value === undefined) return el("td", { title: about }, inner);
  return el("td", { title: about }, el("button", {
    type: "button", class: "number", "data-identity": identity.name, "data-value": String(value),
    onclick: () => { board.open = { row: row.label, identity: identity.name }; show(); },
  }, inner));
}

// The test views behind a number, worst first.
function drill(group) {
  const row = group.rows.find((r) => r.label === board.open.row);
  if (!row) return null;
  const identity = board.open.identity;
  const metric = metricOf(identity);
  const scenes = row.runs.map((k) => {
    const run = DATA.runs[k];
    const place = run.identities.indexOf(identity);
    const views = run.views.filter((v) => (v.group ? `${run.method} [${v.group}]` : run.method) === row.row)
      .map((v) => ({ ...v, value: v.scores[place] }));
    const sign = metric.higher ? 1 : -1;
    views.sort((a, b) => sign * (real(a.value) - real(b.value)) || 0);
    return el("section", {}, el("h4", {}, `${run.scene}, seed ${run.seed}: `,
      el("b", {}, shown(run.means[place], metric)), el("small", {}, ` mean of ${views.length} views`)),
    el("div", { class: "views" }, views.map((v) => el("a", {
      href: link("frame", { group: run.group, scene: run.scene, camera: v.camera, frame: v.frame, a: k }),
      title: `${identity} = ${typeof v.value === "object" && v.value ? run.reasons[v.value[0]] : v.value}`,
    }, el("b", {}, shown(v.value, metric)), ` ${v.camera}/${v.frame}`))));
  });
  return el("section", { class: "drill", "aria-live": "polite" },
    el("h3", {}, `${row.label}: ${titled(identity)} `,
      button("close", () => { board.open = null; show(); }, { class: "quiet" })),
    el("p", { class: "note" }, el("code", {}, identity), "; worst test views first."), scenes);
}

function unstable(group) {
  const rows = group.rows.filter((row) => row.kind === "method" && row.unstable.length > 0);
  return rows.length > 0 && el("ul", { class: "note" }, rows.map((row) =>
    el("li", {}, `Unstable seconds: ${row.label}: ${row.unstable.join("; ")}`)));
}

function unfinished(group) {
  const runs = group.runs.map((k) => DATA.runs[k]).filter((run) => run.status !== "done");
  return runs.length > 0 && el("ul", { class: "unfinished" }, runs.map((run) =>
    el("li", {}, `Not done: ${run.method} on ${run.scene}: ${run.status}${run.reason ? ` (${run.reason})` : ""}`)));
}

// The table as it stands, for a paper, a spreadsheet or a page.
function asText(group, columns, form) {
  const head = ["method", "scenes", ...columns.map((i) => titled(i.name)), "fit s", "fit CPU s", "total s"];
  const lines = sortedRows(group).map((row) => [
    row.label, String(scenesOf(group, row).length),
    ...columns.map((i) => {
      const value = meansOf(group, row)[i.name];
      if (form === "CSV") return String(value ?? "");
      const text = value === undefined ? "—" : shown(value, DATA.metrics[i.metric]);
      const mark = row.marks[i.name];
      if (form === "LaTeX") {
        return mark ? `\\${mark === "best" ? "textbf" : "underline"}{${text}}` : text.replace("∞", "$\\infty$");
      }
      return mark === "best" ? `**${text}**` : text;
    }),
    ...[row.fit, row.cpu, row.total].map((spent) => (row.kind === "method" ? seconds(spent) : "")),
  ]);
  if (form === "CSV") {
    const quoted = (cell) => (/[",\n]/.test(cell) ? `"${cell.replaceAll('"', '""')}"` : cell);
    const about = ["protocol", group.protocol, group.digest, group.profile, group.data];
    return [about, head, ...lines].map((line) => line.map(quoted).join(",")).join("\n");
  }
  if (form === "Markdown") {
    const safe = (cell) => cell.replace(/[\\`*_|<>[\]]/g, (c) => (c === "*" ? c : `\\${c}`));
    return [head, head.map((_, k) => (k ? "---:" : "---")), ...lines]
      .map((line, n) => `| ${(n === 1 ? line : line.map(safe)).join(" | ")} |`).join("\n");
  }
  const special = { "\\": "\\textbackslash{}", "~": "\\textasciitilde{}", "^": "\\textasciicircum{}" };
  const tex = (cell) => cell.replace(/[\\{}$&#%_~^]/g, (c) => special[c] ?? `\\${c}`)
    .replaceAll("↑", "$\\uparrow$").replaceAll("↓", "$\\downarrow$").replaceAll("—", "---");
  const row = (line) => `${[tex(line[0]), ...line.slice(1)].join(" & ")} \\\\`;
  return [`% ${group.protocol} (${group.digest}), ${group.profile} profile, ${group.data}`.replaceAll("\n", " "),
    `\\begin{tabular}{l${"r".repeat(head.length - 1)}}`, "\\toprule", `${head.map(tex).join(" & ")} \\\\`, "\\midrule",
    ...lines.map(row), "\\bottomrule", "\\end{tabular}"].join("\n");
}
