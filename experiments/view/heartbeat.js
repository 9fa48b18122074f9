// Age of the picture that this page shows, by the clock of its server, and the report of it there; and whether an
// emergency stop of this page arrived. What it says stands in front of the page, which grows pale without its server.
(() => {
  "use strict";
  const ASK_MS = 500, SHOW_MS = 250, LIMIT_MS = 5000, KEPT = 60;
  const OLD_S = 2; // an older picture is shown in red
  const CUT_S = 3; // without an answer for longer, the page counts as cut off
  const STOP_MS = 3000, STOP_LIMIT_MS = 1500; // until a stop counts as not sent, and of each question for it
  const LATE_MS = 3000; // what a hand did longer ago is no order any more
  const NOT_SENT = "Type ./zenpark estop in a terminal.";
  const answers = []; // of the server: time of the round trip and offset of its clock [ms]
  let offset = null; // of the quickest answer
  let answered = Date.now(), refused = false;
  let stops = 0; // that the server has received
  const banner = document.createElement("div"), alarm = document.createElement("div");

  const last = selector => [...document.querySelectorAll(selector)].pop();
  const now = () => (Date.now() + (offset ?? 0)) / 1000; // [s] by the server's clock
  const silence = () => (Date.now() - answered) / 1000; // [s]
  const pause = ms => new Promise(done => setTimeout(done, ms));

  async function question(limit) {
    const picture = last("[data-drawn]")?.dataset ?? {}, begun = Date.now();
    const report = new URLSearchParams({
      page: last("[data-page]")?.dataset.page ?? "",
      drawn: picture.drawn ?? "", stage: picture.stage ?? "", hidden: document.hidden ? "1" : "0",
    });
    try {
      const response = await fetch(`clock?${report}`, { cache: "no-store", signal: AbortSignal.timeout(limit) });
      const [time, count] = (await response.text()).split(" ").map(Number), ended = Date.now();
      refused = response.status === 403;
      if (!response.ok || !Number.isFinite(time)) return false;
      answers.push({ trip: ended - begun, offset: 1000 * time - (begun + ended) / 2 });
      answers.splice(0, answers.length - KEPT);
      offset = answers.reduce((one, other) => (other.trip < one.trip ? other : one)).offset;
      [answered, stops] = [ended, count];
      return true;
    } catch { // no answer: its absence is shown
      return false;
    }
  }

  async function ask() {
    for (;;) {
      await question(LIMIT_MS);
      await pause(ASK_MS);
    }
  }

  function show() {
    const picture = last("[data-drawn]")?.dataset, silent = silence(), cut = refused || silent > CUT_S;
    const at = picture?.picture ? Number(picture.picture) : null;
    const age = at === null ? null : Math.max(0, now() - at);
    const words = [];
    if (refused) words.push("this page is of a former ./zenpark view: open the address that the new one printed");
    else if (cut) words.push(`CUT OFF: no answer of zenpark for ${silent.toFixed(0)} s`);
    if (age !== null && !picture.over) words.push(`picture is ${age.toFixed(age < 10 ? 1 : 0)} s old`);
    if (picture?.words) words.push(picture.words);
    const old = !picture?.over && (cut || (age !== null && offset !== null && age > OLD_S));
    const root = document.documentElement, text = words.join("; ");
    root.style.setProperty("--zenpark-age", JSON.stringify(text));
    root.style.setProperty("--zenpark-age-colour", old ? "rgb(213,50,30)" : "currentColor");
    root.style.setProperty("--zenpark-age-weight", old ? "700" : "400");
    Object.assign(root.dataset, { age: text, old: old ? "1" : "", still: cut || picture?.over ? "1" : "" });
    banner.textContent = picture?.over ? `LAST PICTURE: ${picture.words}` : cut ? text : "";
    banner.style.background = picture?.over ? "rgb(70,74,82)" : "rgb(213,50,30)";
    if (document.body && !banner.isConnected) document.body.append(banner, alarm);
  }

  async function watchStop() {
    const before = stops, until = Date.now() + STOP_MS;
    let why = "zenpark has not received it.";
    alarm.textContent = "";
    while (Date.now() < until && stops === before) {
      if (refused || silence() > CUT_S || !(await question(STOP_LIMIT_MS))) {
        why = "this page is cut off.";
        break;
      }
      await pause(100);
    }
    if (stops === before) alarm.textContent = `EMERGENCY STOP NOT SENT: ${why} ${NOT_SENT}`;
  }

  // The button by its place: a page without its server has a cover, which takes the click.
  const pressed = event => [...document.querySelectorAll("button")].some(button => {
    const { left, right, top, bottom } = button.getBoundingClientRect();
    const inside = left <= event.clientX && event.clientX <= right && top <= event.clientY && event.clientY <= bottom;
    return button.textContent.includes("EMERGENCY STOP") && (inside || button.contains(event.target));
  });
  const stopping = event =>
    event.type === "keydown" ? event.shiftKey && event.key?.toUpperCase() === "S" : pressed(event);
  for (const kind of ["pointerdown", "mousedown", "click", "keydown"])
    addEventListener(kind, event => {
      const stop = stopping(event); // it counts however late the page gets to it
      if (stop && ["click", "keydown"].includes(kind) && !event.repeat) watchStop();
      if (stop || performance.now() - event.timeStamp < LATE_MS) return;
      event.stopImmediatePropagation();
      event.preventDefault();
    }, { capture: true });

  const front = "position:fixed;z-index:2147483647;color:white;font:600 1.1em sans-serif;text-align:center;";
  banner.style.cssText = `${front}top:0;left:0;right:0;padding:0.4em;pointer-events:none`;
  alarm.style.cssText = `${front}top:30%;left:5%;right:5%;padding:1em;font-size:2em;background:rgb(213,50,30)`;
  alarm.onclick = () => { alarm.textContent = ""; };
  banner.role = alarm.role = "alert";
  const style = document.createElement("style");
  style.textContent = "html[data-still='1'] canvas{filter:grayscale(1) opacity(0.5)}" +
    "body>[role=alert]:empty{display:none}";
  document.head.append(style);

  addEventListener("visibilitychange", show);
  setInterval(show, SHOW_MS);
  ask();
})();
