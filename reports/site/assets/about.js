// Where every number came from, and the command that makes it again.

function aboutTab(group) {
  return [
    el("section", {}, el("h3", {}, `Protocol ${group.protocol}, ${group.profile} profile, digest ${group.digest}`),
      el("p", {}, group.standin && el("b", { class: "badge" }, "stand-in"), ` ${group.data}`),
      el("details", {}, el("summary", {}, "the whole protocol as TOML"), copyable(group.toml))),
    el("section", {}, el("h3", {}, "Runs"), group.runs.map((k) => runAbout(DATA.runs[k]))),
    DATA.citations.length > 0 && el("section", {}, el("h3", {}, "To cite"), DATA.citations.map(copyable)),
    DATA.left_out.length > 0 && el("section", {}, el("h3", {}, "Left out of this site"),
      el("ul", {}, DATA.left_out.map((line) => el("li", {}, line)))),
    el("section", {}, el("h3", {}, "This page"), el("p", {}, DATA.made),
      DATA.notes.map((note) => el("p", { class: "note" }, note))),
  ];
}

function copyable(text) {
  return el("div", { class: "copyable" }, el("pre", { tabindex: "0" }, text),
    button("copy", (event) => copied(text, event.target), { class: "quiet" }));
}

function runAbout(run) {
  return el("details", {}, el("summary", {}, `${run.label} on ${run.scene}, seed ${run.seed}: ${run.status}`),
    run.reason && el("p", {}, run.reason),
    el("p", {}, "Repeat it from its record:"), copyable(run.repeat),
    run.command && [el("p", {}, "It was started by:"), copyable(run.command)],
    Object.entries(run.remarks).map(([kind, said]) =>
      [el("p", {}, `${kind[0].toUpperCase()}${kind.slice(1)}:`), el("ul", {}, said.map((text) => el("li", {}, text)))]),
    el("div", { class: "wide" }, el("table", { class: "facts" }, run.facts.map(([name, value]) =>
      el("tr", {}, el("th", { scope: "row" }, name), el("td", {}, value))))),
    el("details", {}, el("summary", {}, "every switch"), copyable(JSON.stringify(run.config, null, 2))));
}
