// The rig's state, on every page and in every tab: read twice a second, never shown when older than 2 s.
// The page asks (the service does not push): an answer is newer than its question, also after a laptop has slept.
"use strict";
{
  const words = JSON.parse(document.getElementById("rig-words").textContent);
  const EVERY_MS = 500, PATIENCE_MS = 1500, OLD_MS = 2000, LONG_MS = 300000, TORQUE_OLD_S = 1.0, READ_MS = 2000, STOP_MS = 5000;
  const clock = () => [performance.now(), Date.now()]; // the first stands still while a machine sleeps, the second may be set
  const since = (then) => Math.max(performance.now() - then[0], Date.now() - then[1]);
  const pill = document.getElementById("rig-state");
  const live = document.getElementById("live"), said = document.getElementById("page-old"), person = document.querySelector(".who");
  const boxes = (name) => document.querySelectorAll(`[data-now="${name}"]`);
  const begun = clock();
  let heard = said.dataset.at, lost = "", stopped = "", late = 0; // when the page last heard of the service; why what it shows is old
  let known = null, asked = null, last = null, busy = false, fetching = "", notice = document.getElementById("rig-notice");
  let shown = remembered(), focused = false; // the stop whose re-arm this tab showed last, and since when if another was shown before

  const say = (name, text) => { for (const box of boxes(name)) if (box.textContent !== text) box.textContent = text; };
  const figure = (value, digits) => value.toLocaleString(document.documentElement.lang, { minimumFractionDigits: digits, maximumFractionDigits: digits, useGrouping: false }).replace("-", "−");
  const old = () => since(asked || begun) > OLD_MS;

  function get(address) { // aborted in time, its body too; AbortSignal.timeout is missing in browsers before 2022
    const ending = new AbortController();
    setTimeout(() => ending.abort(), PATIENCE_MS);
    return fetch(address, { cache: "no-store", signal: ending.signal });
  }

  async function ask() {
    if (busy) return;
    busy = true;
    const moment = last = clock();
    try {
      const answer = await get("/rig/now");
      if (answer.ok) { known = await answer.json(); touch(known); asked = moment; dispatchEvent(new CustomEvent("rig-now", { detail: known })); }
    } catch { /* what is shown grows old, and says so */ }
    busy = false;
    show();
  }

  function touch(now) { // what was not heard of for long stays in doubt until the page is read anew
    if (person && now.signed_in === false && !now.locked) lost = "signed_out";
    else if (since(asked || begun) > LONG_MS) lost = "out_of_touch";
    else if (lost === "signed_out") lost = "out_of_touch"; // signed in again, in another tab: perhaps somebody else
    if (!lost) heard = now.at;
  }

  function doubt(why) {
    said.hidden = !why;
    if (!why) return;
    const text = words[why].replace("{time}", heard), [box, door, anew] = said.children;
    if (box.textContent !== text) box.textContent = text;
    door.hidden = why !== "signed_out"; anew.hidden = why !== "out_of_touch";
  }

  async function stop(form) { // a browser would leave the page, its stop button with it, for a page of its own
    stopped = "stopping"; show();
    try { // not given up: it may still stop, late
      const answer = await fetch(form.action, { method: "POST", body: new URLSearchParams(new FormData(form)), headers: { Accept: "text/html" } });
      clearTimeout(late); late = 0;
      if (answer.redirected) location.assign(answer.url); else form.submit();
    } catch { notStopped(); }
  }

  function notStopped() { clearTimeout(late); late = 0; stopped = "not_stopped"; show(); }

  function show() {
    doubt(stopped || (live ? "" : old() ? "no_answer" : lost)); // a running test's page says it itself
    if (old()) return bar("unknown", words.unknown, words.silent, false);
    if (!known) return; // what the service wrote into the page stands, with its time
    bar(known.state, known.flow, known.more, known.ready);
    document.dispatchEvent(new CustomEvent("rig", { detail: known })); // for scripts that follow what the rig does
    if (known.test !== undefined) test(known.test);
    if (known.notice !== undefined) renew(known.notice);
  }

  function bar(state, flow, more, ready) {
    const name = "pill state-" + state;
    if (pill.className !== name) pill.className = name;
    say("flow", flow); say("more", more); say("at", ""); say("torque", torque());
    say("angle", angle());
    for (const box of document.querySelectorAll("[data-needs-ready]")) box.disabled = !ready || !there(box);
    for (const box of document.querySelectorAll("[data-at-angle]")) box.classList.toggle("is-there", there(box));
  }

  function angle() { return old() || !known || typeof known.angle_deg !== "number" ? "–" : figure(known.angle_deg, 0) + "°"; }

  function there(box) { // whether the joint is where a held test begins; where none is asked for, it is
    if (box.dataset.angleFrom === undefined) return true;
    if (old() || !known || typeof known.angle_deg !== "number") return false;
    return known.angle_deg >= Number(box.dataset.angleFrom) && known.angle_deg <= Number(box.dataset.angleTo);
  }

  function torque() {
    if (old() || !known) return words.no_value;
    if (typeof known.torque_age_s !== "number") return words.none;
    const age = known.torque_age_s + since(asked) / 1000;
    if (known.torque_nm === null || age > TORQUE_OLD_S) return words.no_torque.replace("{age}", figure(age, 1));
    return words.torque.replace("{torque}", figure(known.torque_nm, 2)).replace("{age}", figure(age, 1));
  }

  function test(current) {
    for (const box of document.querySelectorAll("[data-when]")) box.hidden = (box.dataset.when === "busy") !== (current !== null);
    for (const tag of document.querySelectorAll("[data-running]")) {
      if (current && current.id === tag.dataset.running) continue;
      tag.textContent = words.ended; tag.className = "tag"; delete tag.dataset.running; // how, the page says when it is loaded
    }
    if (!current) return;
    for (const link of boxes("test")) link.setAttribute("href", "/tests/" + current.id);
    say("participant", current.participant);
  }

  async function renew(key) {
    if (!notice || notice.dataset.key === key || fetching === key) return;
    fetching = key;
    try {
      focused = notice.contains(document.activeElement);
      await act.renew(["rig-notice"]);
    } catch { /* the next answer asks again */ }
    fetching = "";
  }

  function remembered() { try { return JSON.parse(sessionStorage.getItem("rearm")) || {}; } catch { return {}; } }

  function hold() { // another stop came under the hand that was about to re-arm, here or as the page was loaded anew: it is read first
    const form = document.getElementById("rearm"), button = form?.querySelector("button"), latch = form?.dataset.ifMatch;
    if (!form) return;
    if (latch !== shown.latch) {
      shown = { latch, since: shown.latch ? Date.now() : 0 };
      try { sessionStorage.setItem("rearm", JSON.stringify(shown)); } catch { /* not kept */ }
    }
    const left_ms = Math.min(READ_MS, READ_MS - (Date.now() - shown.since)), back = focused;
    if (left_ms <= 0) return;
    button.disabled = true;
    setTimeout(() => { button.disabled = false; if (back && document.activeElement === document.body) button.focus(); }, left_ms);
  }

  function look() {
    show();
    if (!document.hidden && (!last || since(last) >= EVERY_MS)) ask();
  }
  const now = () => { show(); if (!document.hidden) ask(); };
  setInterval(look, 250);
  hold();
  addEventListener("renewed", ({ detail }) => { // at once, before anything can be pressed
    if (!detail.includes("rig-notice")) return;
    notice = document.getElementById("rig-notice");
    hold();
  });
  said.lastElementChild.addEventListener("click", () => location.reload());
  addEventListener("submit", (event) => {
    if (event.target.id !== "stop-form") return;
    late = late || setTimeout(notStopped, STOP_MS); // counted from the first press: who presses on must not wait longer
    if (!old()) return; // the service answers: the form by itself, as without scripts
    event.preventDefault();
    stop(event.target);
  });
  addEventListener("pageshow", (event) => { if (event.persisted) location.reload(); else now(); }); // kept by Back: all of it is old
  document.addEventListener("visibilitychange", now);
  addEventListener("online", now);
  now();
}
