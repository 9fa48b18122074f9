// Age of the picture that this page shows, by the clock of its server, and the report of it there.
(() => {
  "use strict";
  const ASK_MS = 500, SHOW_MS = 250, LIMIT_MS = 5000, KEPT = 60;
  const OLD_S = 2; // an older picture is shown in red
  const LATE_MS = 3000; // what a hand did longer ago is no order any more
  const answers = []; // of the server: time of the round trip and offset of its clock [ms]
  let offset = null; // of the quickest answer
  let answered = Date.now();

  const last = selector => [...document.querySelectorAll(selector)].pop();
  const now = () => (Date.now() + (offset ?? 0)) / 1000; // [s] by the server's clock

  async function ask() {
    const picture = last("[data-drawn]")?.dataset ?? {}, begun = Date.now();
    const report = new URLSearchParams({
      page: last("[data-page]")?.dataset.page ?? "",
      drawn: picture.drawn ?? "", stage: picture.stage ?? "", hidden: document.hidden ? "1" : "0",
    });
    try {
      const response = await fetch(`clock?${report}`, { cache: "no-store", signal: AbortSignal.timeout(LIMIT_MS) });
      const server = 1000 * Number(await response.text()), ended = Date.now();
      if (response.ok && Number.isFinite(server)) {
        answers.push({ trip: ended - begun, offset: server - (begun + ended) / 2 });
        answers.splice(0, answers.length - KEPT);
        offset = answers.reduce((one, other) => (other.trip < one.trip ? other : one)).offset;
        answered = ended;
      }
    } catch { /* no answer: its absence is shown */ }
    setTimeout(ask, ASK_MS);
  }

  function show() {
    const picture = last("[data-drawn]")?.dataset, silent = (Date.now() - answered) / 1000;
    const at = picture?.picture ? Number(picture.picture) : null;
    const age = at === null ? null : Math.max(0, now() - at);
    const words = [];
    if (silent > OLD_S + 1) words.push(`no answer of zenpark for ${silent.toFixed(0)} s`);
    if (age !== null) words.push(`picture is ${age.toFixed(age < 10 ? 1 : 0)} s old`);
    if (picture?.over) words.length = 0;
    if (picture?.words) words.push(picture.words);
    const old = !picture?.over && (silent > OLD_S + 1 || (age !== null && offset !== null && age > OLD_S));
    const style = document.documentElement.style;
    style.setProperty("--zenpark-age", JSON.stringify(words.join("; ")));
    style.setProperty("--zenpark-age-colour", old ? "rgb(213,50,30)" : "currentColor");
    style.setProperty("--zenpark-age-weight", old ? "700" : "400");
    document.documentElement.dataset.age = words.join("; ");
    document.documentElement.dataset.old = old ? "1" : "";
  }

  // An emergency stop counts however late the page gets to it.
  const stops = event =>
    event.type === "keydown" ? event.shiftKey && event.key?.toUpperCase() === "S"
    : event.target?.closest?.("button")?.textContent.includes("EMERGENCY STOP");
  for (const kind of ["pointerdown", "mousedown", "click", "keydown"])
    addEventListener(kind, event => {
      if (performance.now() - event.timeStamp < LATE_MS || stops(event)) return;
      event.stopImmediatePropagation();
      event.preventDefault();
    }, { capture: true });

  addEventListener("visibilitychange", show);
  setInterval(show, SHOW_MS);
  ask();
})();
