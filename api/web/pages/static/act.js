// Forms that call REST: `<form data-call="PUT /v1/...">`. Fields become JSON; the answer leads on, or is shown where it belongs.
// The attributes that it reads are listed in docs/decisions/0021-one-script.md.
"use strict";
const act = (() => {
  const PATIENCE_MS = 30000, FILE_PATIENCE_MS = 600000, READ_MS = 2000;
  const words = JSON.parse(document.getElementById("rig-words").textContent);
  const NUMBER = /^[-−]?(?:0|[1-9]\d{0,4})(?:[.,]\d{1,2})?$/, WHOLE = /^(?:0|[1-9]\d{0,4})$/;
  const here = () => location.pathname + location.search;
  const make = (tag, given = {}, ...children) => { const box = Object.assign(document.createElement(tag), given); box.append(...children); return box; };
  const alertBox = (given, ...children) => { const box = make("p", given, ...children); box.setAttribute("role", "alert"); return box; };
  let pending = 0, focused = "";

  // ---- reading a form ----------------------------------------------------------------------------------------------

  function readField(field, types) {
    const text = field.value.trim(), kind = types.find((type) => type !== "list");
    const wrong = (why) => Object.assign(new Error(words[why].replace("{text}", text)), { field });
    if (kind === "int" && !WHOLE.test(text)) throw wrong("no_whole");
    if (kind === "int") return Number(text);
    if (kind !== "number" && kind !== "degrees") return text;
    const unchanged = text && text === field.defaultValue && Number.isFinite(Number(text)); // the page's own, however fine
    if (!unchanged && !NUMBER.test(text)) throw wrong("no_number");
    const value = Number(text.replace("−", "-").replace(",", "."));
    return kind === "degrees" ? (value * Math.PI) / 180 : value;
  }

  function readFields(fields) { // all of one name; undefined: nothing to send
    const last = fields[fields.length - 1], types = (last.dataset.type || "").split(" "), filled = fields.filter((field) => field.value.trim());
    if (types[0] === "flag") return last.type === "checkbox" ? last.checked : last.value === "true";
    if (!filled.length) return last.dataset.empty === "null" ? null : undefined;
    if (types[0] === "list") return filled.flatMap((field) => field.value.trim().split(/[\s,]+/));
    return types.includes("list") ? fields.map((field) => readField(field, types)) : readField(filled[filled.length - 1], types);
  }

  function put(body, name, value) {
    const path = name.split("."), last = path.pop();
    path.reduce((part, key) => (part[key] ??= {}), body)[last] = value;
  }

  function read(form, button) {
    const sent = { body: {}, query: new URLSearchParams(), values: {}, file: null, password: null, errors: [] }, groups = new Map();
    const ticked = (field) => !["radio", "checkbox"].includes(field.type) || field.checked || field.dataset.type === "flag";
    const fields = [...form.elements].filter((field) => field.name && !field.disabled && field.tagName !== "BUTTON" && ticked(field));
    for (const field of button?.name ? [...fields, button] : fields) {
      if (field.type === "file") sent.file = field.files[0];
      else if (field.dataset.confirm !== undefined) sent.password = field.value;
      else groups.set(field.name, [...(groups.get(field.name) || []), field]);
    }
    const same = (field) => field.type !== "hidden" && field.value === field.defaultValue;
    for (const [name, group] of groups) {
      const query = group[0].dataset.query !== undefined;
      if (form.dataset.changed !== undefined && !query && group.every(same)) continue;
      try {
        const value = readFields(group);
        sent.values[name] = value;
        if (value === undefined) continue;
        if (query) sent.query.append(name, value); else put(sent.body, name, value);
      } catch (error) { sent.errors.push(error); }
    }
    return sent;
  }

  // ---- calling -----------------------------------------------------------------------------------------------------

  async function request(call, { body = {}, file, version, token } = {}) {
    const [method, address] = call.split(" "), at = new URL(address, location.href), ending = new AbortController();
    const headers = { Accept: "application/json", "X-CSRF-Token": document.querySelector("meta[name=csrf]").content };
    if (file) for (const [name, value] of Object.entries(body)) at.searchParams.append(name, value);
    if (!file && method !== "DELETE") headers["Content-Type"] = "application/json";
    if (version) headers["If-Match"] = `"${version}"`;
    if (token) at.searchParams.set("confirm", token);
    const timer = setTimeout(() => ending.abort(), file ? FILE_PATIENCE_MS : PATIENCE_MS);
    try {
      const answer = await fetch(at, { method, headers, cache: "no-store", signal: ending.signal, body: method === "DELETE" ? undefined : file || JSON.stringify(body) });
      const json = answer.status !== 204 && /json/.test(answer.headers.get("content-type")) ? await answer.json() : null, etag = answer.headers.get("etag") || "";
      return { ok: answer.ok, status: answer.status, etag: etag.replace(/^W\/|"/g, ""), location: answer.headers.get("location") || "", body: json };
    } finally { clearTimeout(timer); }
  }

  async function send(form, button, more = {}) {
    const given = { ...form.dataset, ...button?.dataset }, sent = more.sent || read(form, button);
    if (form.ariaBusy === "true") return; // pressed twice: sent once
    clear(form);
    for (const { field, message } of sent.errors) atField(field, message);
    if (sent.errors.length) { sent.errors[0].field.focus(); return; }
    let answer = { ok: true };
    form.ariaBusy = "true"; pending += 1;
    try {
      if (sent.password !== null) answer = await request("POST /v1/sessions/confirm", { body: { password: sent.password } });
      if (answer.ok) answer = await request(given.call, { body: sent.body, file: sent.file, version: more.version || given.ifMatch, token: more.token });
    } catch { answer = null; }
    form.ariaBusy = "false"; pending -= 1;
    if (!answer) atTop(words.not_written);
    else if (answer.ok) await lead(form, given, sent, answer);
    else refused(form, given, sent, answer, (again) => send(form, button, { sent, ...again }));
    form.dispatchEvent(new CustomEvent("answered", { bubbles: true, detail: answer }));
  }

  async function lead(form, given, sent, answer) {
    const value = (path) => path.split(".").reduce((part, key) => part?.[key], answer.body) ?? "";
    const job = answer.status === 202 && /\/v1\/jobs\/([^/]+)$/.exec(answer.location);
    if (job) { location.assign("/jobs/" + job[1]); return; }
    if (given.show || given.renew) form.reset();
    if (given.renew) { await renew(given.renew.split(" ")); return; }
    if (given.show) {
      const box = document.getElementById(given.show);
      for (const part of box.querySelectorAll("[data-answer]")) part.textContent = value(part.dataset.answer);
      box.hidden = false; box.focus();
      return;
    }
    if (given.next === undefined) { location.reload(); return; }
    const filled = given.next.replace(/\{(answer\.)?([\w.]+)\}/g, (_, of, name) => encodeURIComponent(of ? value(name) : sent.values[name] ?? ""));
    const next = new URL(filled, location.href);
    for (const [name, text] of sent.query) next.searchParams.append(name, text);
    const same = next.pathname + next.search === here();
    location.assign(next);
    if (same) location.reload(); // another hash alone loads nothing
  }

  async function renew(ids) { // these elements, as the page has them now
    const answer = await fetch(here(), { cache: "no-store", headers: { Accept: "text/html" } });
    const page = new DOMParser().parseFromString(await answer.text(), "text/html");
    // A refusal that has them will do: the page before a test is refused once it is started, and must not keep the test's own page from opening.
    const found = answer.ok || ids.every((id) => page.getElementById(id));
    if (!found || answer.redirected) { location.assign(answer.redirected ? answer.url : here()); return; }
    for (const id of ids) if (page.getElementById(id)) document.getElementById(id)?.replaceWith(page.getElementById(id));
    const last = focused && document.getElementById(focused); // a button that was disabled, or replaced, has lost the focus
    if (last && !last.disabled && ids.some((id) => document.getElementById(id)?.contains(last)) && document.activeElement === document.body) last.focus({ preventScroll: true });
    dispatchEvent(new CustomEvent("renewed", { detail: ids }));
  }

  // ---- what was refused --------------------------------------------------------------------------------------------

  function refused(form, given, sent, answer, again) {
    const problem = answer.body || { title: words.not_written }, kind = (problem.type || "").split("/").pop();
    if (kind === "locked") { location.assign("/locked?next=" + encodeURIComponent(here())); return; }
    if (kind === "unauthorized" && given.call !== "POST /v1/sessions") { location.assign("/sign-in?next=" + encodeURIComponent(here())); return; }
    if (answer.status === 412 && given.again !== "none") { ask(overtaken(problem, given), () => (given.again === "reload" ? location.reload() : again({ version: answer.etag })), true); return; }
    if (problem.confirm) { ask(problem.confirm, () => again({ token: problem.confirm.token })); return; }
    const rest = [];
    for (const { field: name, detail: said } of problem.errors || []) {
      const detail = said.replace(/^Value error, /, "");
      const found = form.elements[name] || form.elements[name.replace(/\.\d+$/, "")], field = found instanceof RadioNodeList ? found[found.length - 1] : found;
      if (field && field.type !== "hidden") atField(field, field.title && /match pattern/.test(detail) ? field.title : detail);
      else rest.push(name === "body" ? detail : `${name}: ${detail}`);
    }
    form.querySelector("[aria-invalid]")?.focus();
    atTop(problem.title, problem.errors ? rest.join(" ") || words.see_field : problem.detail, problem.holder?.test_id);
  }

  function atField(field, text) {
    const id = (field.id || field.name) + "-error", help = field.getAttribute("aria-describedby") || "";
    field.setAttribute("aria-invalid", "true");
    field.setAttribute("aria-describedby", `${help.replace(id, "")} ${id}`.trim());
    field.after(make("p", { id, className: "wrong", textContent: text }));
  }

  function atTop(title, detail = "", test = "") {
    const box = alertBox({ id: "refused", className: "notice bad" }, make("b", { textContent: title }), " " + detail);
    if (test) box.append(" ", make("a", { className: "button", href: "/tests/" + test, textContent: words.see_test }));
    document.getElementById("main").prepend(box);
    box.scrollIntoView({ block: "nearest" });
  }

  function clear(form) {
    for (const box of document.querySelectorAll("#refused, #asked")) box.remove();
    for (const box of form.querySelectorAll(".wrong")) box.remove();
    for (const field of form.querySelectorAll("[aria-invalid]")) field.removeAttribute("aria-invalid");
  }

  function overtaken({ title, detail, changes = [] }, { again }) {
    const rows = changes.map((each) => ({ what: each.action, before: each.old, now: each.new, who: [each.who, new Date(each.at_utc).toLocaleTimeString()].filter(Boolean).join(", ") }));
    const button = again === "reload" ? words.show_anew : again || words.all_the_same;
    return { title, warnings: [words.changed, ...(rows.length ? [] : [detail])], rows, button };
  }

  // Not modal: that would put the stop button out of reach. `late`: it is read before it can be pressed.
  function ask({ title, warnings = [], rows = [], button = words.yes }, yes, late = false) {
    const cell = (tag, value) => make(tag, { textContent: value || "–", scope: "row" }), heads = ["", words.before, words.now, ...(rows.some((row) => row.who) ? [words.who] : [])];
    const lines = rows.map((row) => make("tr", {}, cell("th", row.what), cell("td", row.before), make("td", {}, cell("b", row.now)), ...(row.who ? [cell("td", row.who)] : [])));
    const box = make("dialog", { id: "asked", className: "card question" }, make("h2", { id: "asked-title", textContent: title }));
    const go = make("button", { type: "button", className: "big primary", textContent: button, disabled: late, onclick: () => { box.remove(); yes(); } });
    const no = make("button", { type: "button", className: "big", textContent: words.no, onclick: () => box.remove() });
    box.setAttribute("aria-labelledby", "asked-title");
    box.append(...warnings.map((text) => alertBox({ className: "notice warn", textContent: text })));
    if (rows.length) box.append(make("table", { className: "asked" }, make("thead", {}, make("tr", {}, ...heads.map((head) => make("th", { textContent: head })))), make("tbody", {}, ...lines)));
    box.append(make("p", { className: "steps" }, go, " ", no));
    document.getElementById("main").prepend(box);
    box.show();
    no.focus();
    scrollTo(0, 0);
    if (late) setTimeout(() => { go.disabled = false; }, READ_MS);
  }

  document.addEventListener("focusin", (event) => { focused = event.target.id; });
  document.addEventListener("submit", (event) => {
    if (event.target.dataset.call === undefined && event.submitter?.dataset.call === undefined) return;
    event.preventDefault();
    send(event.target, event.submitter);
  });
  return { send, read, renew, request, busy: () => pending > 0 };
})();
