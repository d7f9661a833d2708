// Of a page that `ihbench view` serves: what runs do that are not done, and that there is something new.

const ASK_EVERY = 3000; // ms

function follow() {
  if (!DATA.live) return;
  let asked = false;
  setInterval(async () => {
    if (asked || document.hidden) return;
    asked = true;
    try {
      const answer = await fetch("/state", { cache: "no-store" });
      told(await answer.json());
    } catch {
      document.getElementById("live").replaceChildren("the server has ended; start ihbench view again");
    }
    asked = false;
  }, ASK_EVERY);
}

function told(state) {
  let drawn = false;
  for (const one of state.runs) {
    const run = DATA.runs.find((r) => r.name === one.name);
    if (!run || run.curve.length === one.curve.length) continue;
    run.curve = one.curve;
    drawn = true;
  }
  document.getElementById("live").replaceChildren(...[
    state.version !== DATA.live.version && button("there is something new: load it", () => location.reload(), { "data-action": "reload" }),
    state.fault && el("p", {}, state.fault),
    state.runs.length > 0 && el("ul", {}, state.runs.map((one) => el("li", {}, one.words))),
  ].filter(Boolean));
  if (drawn && document.getElementById("main").dataset.tab === "curves") show();
}
