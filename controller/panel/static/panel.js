"use strict";
// Updates the live parts of the page. Without this script the pages work, but need a reload.
(() => {
  const body = document.body;
  const link = document.getElementById("link");
  const camera = document.getElementById("camera");
  const sees = document.getElementById("sees");
  const photograph = document.getElementById("photograph");
  let running = false;
  const measured = document.querySelector('form[action="/do/test-shots"]');

  function follow() {
    // The server sends HTML that is escaped by the same templates as the page.
    const job = document.getElementById("live-job");
    const line = job && job.querySelector("[data-running]");
    // Reload the aiming page when the test shots are done.
    if (measured && running && !line) location.reload();
    running = Boolean(line);
    // What is not possible now is hidden; without the script the page is drawn so.
    const now = document.querySelector("[data-flags]");
    const flags = new Set(now ? now.dataset.flags.split(" ") : []);
    for (const place of document.querySelectorAll("[data-if]")) {
      place.hidden = !place.dataset.if.split(" ").every((word) => word[0] === "!" ? !flags.has(word.slice(1)) : flags.has(word));
    }
    for (const form of document.querySelectorAll("[data-plays]")) {
      form.querySelector("button").setAttribute("aria-pressed", String(Boolean(now) && now.dataset.playing === form.dataset.plays));
    }
    if (sees && !running && !(camera && camera.dataset.always)) sees.hidden = true;
    if (photograph && !running) photograph.hidden = true;
    const made = document.querySelector("#made [name=name]");
    if (made && now && now.dataset.made) made.value = now.dataset.made;
    if (now && bundle !== undefined && bundle !== now.dataset.bundle) refresh();
    if (now) bundle = now.dataset.bundle;
  }

  // A new bundle: its appearances and their pictures come to an open page, too.
  let bundle;
  async function refresh() {
    if (!document.querySelector(".shelf")) return;
    try {
      const answer = await fetch(location.href, { redirect: "manual" });
      const page = new DOMParser().parseFromString(await answer.text(), "text/html");
      for (const place of document.querySelectorAll(".shelf")) {
        const now = page.getElementById(place.id);
        if (now) place.replaceWith(now);
      }
      follow();
    } catch { /* not reachable: the next change or load brings it */ }
  }

  function draw(parts) {
    for (const [name, html] of Object.entries(parts)) {
      const place = document.getElementById("live-" + name);
      if (place && place.dataset.drawn !== html) {
        const unfolded = [...place.querySelectorAll("details[open]")].map((one) => one.dataset.keep);
        place.innerHTML = html;
        place.dataset.drawn = html;
        for (const one of place.querySelectorAll("details")) one.open = unfolded.includes(one.dataset.keep);
      }
    }
    follow();
    reachable();
  }

  function say(text) {
    if (link && link.textContent !== text) link.textContent = text;
  }

  const LATE_MS = 6000;
  let heard = Date.now();

  function hear() {
    heard = Date.now();
    say("");
  }

  function listen() {
    const source = new EventSource(body.dataset.live);
    heard = Date.now();
    source.addEventListener("open", hear);
    source.addEventListener("still", hear);
    source.addEventListener("parts", (event) => { hear(); draw(JSON.parse(event.data)); });
    // A server that hangs, or a network that is gone, ends no stream.
    const watch = setInterval(() => { if (Date.now() - heard > LATE_MS) say(body.dataset.lost); }, 1000);
    source.addEventListener("reload", () => { clearInterval(watch); source.close(); listen(); });
    source.addEventListener("full", () => say(body.dataset.full));
    source.addEventListener("error", () => {
      say(body.dataset.lost);
      if (source.readyState === EventSource.CLOSED) {
        // Refused: the session has ended, or the service is starting.
        clearInterval(watch);
        setTimeout(async () => {
          try {
            const answer = await fetch(body.dataset.live, { method: "HEAD", redirect: "manual" });
            if (answer.status === 401 || answer.type === "opaqueredirect") { keep(); location.assign("/login"); return; }
          } catch { /* not reachable yet */ }
          listen();
        }, 1000);
      }
    });
    addEventListener("pagehide", () => source.close(), { once: true });
  }

  function look() {
    if (document.hidden) return;
    if (camera && (running || camera.dataset.always)) show(camera, sees);
    if (photograph && running) show(document.getElementById("taken"), photograph);
  }

  function show(picture, place) {
    const next = new Image();
    next.onload = () => {
      picture.src = next.src;
      if (place) place.hidden = false;
      picture.dispatchEvent(new CustomEvent("seen", { detail: next }));
    };
    next.src = picture.dataset.src + "?t=" + Date.now();
  }

  // What takes seconds comes after the page.
  async function late(place) {
    let html = "";
    for (const waiting of place.querySelectorAll(".waiting")) waiting.hidden = false;
    try {
      const answer = await fetch(place.dataset.late, { redirect: "manual" });
      if (answer.type === "opaqueredirect") { location.assign("/login"); return; }
      html = await answer.text();
    } catch { /* not reachable */ }
    if (html) {
      place.innerHTML = html;
      for (const inner of place.querySelectorAll("[data-late]")) late(inner);
    } else place.querySelector(".waiting").textContent = body.dataset.lateLost;
  }
  for (const place of document.querySelectorAll("[data-late]")) {
    if (!place.dataset.again) late(place);
    // Not while somebody is about to press something there.
    else setInterval(() => { if (!document.hidden && !place.matches(":hover, :focus-within")) again(place); }, 1000 * place.dataset.again);
  }
  async function again(place) {
    try {
      const answer = await fetch(place.dataset.late, { redirect: "manual" });
      const html = answer.ok ? await answer.text() : "";
      if (html && place.dataset.drawn !== html) { place.innerHTML = html; place.dataset.drawn = html; }
    } catch { /* not reachable: the next time brings it */ }
  }

  for (const range of document.querySelectorAll("input[type=range]")) {
    const shown = document.querySelector(`output[for=${range.id}]`);
    if (shown) range.addEventListener("input", () => { shown.textContent = shown.textContent.replace(/[0-9]+/, range.value); });
  }

  // What is wider than the screen scrolls on its own, also by the keyboard.
  function reachable() {
    for (const wide of document.querySelectorAll(".wide")) {
      if (wide.scrollWidth > wide.clientWidth) wide.tabIndex = 0;
      else wide.removeAttribute("tabindex");
    }
  }
  addEventListener("resize", reachable);
  reachable();

  // What was typed outlives the session: it is kept in this tab until its page is open again.
  const changed = (field) => !["password", "hidden", "file"].includes(field.type) && (["checkbox", "radio"].includes(field.type)
    ? field.checked !== field.defaultChecked : field.value !== (field.defaultValue ?? [...field.options].find((one) => one.defaultSelected)?.value));
  const fields = () => [...document.querySelectorAll("main input, main textarea, main select")];
  function keep() {
    const typed = fields().map((field, at) => [at, field.name, field.checked, field.value, field]).filter((row) => changed(row[4]));
    if (!typed.length) return;
    sessionStorage.setItem("typed", JSON.stringify({ path: location.pathname, who: body.dataset.who, rows: typed.map((row) => row.slice(0, 4)) }));
  }
  function restore() {
    const typed = JSON.parse(sessionStorage.getItem("typed") ?? "null");
    if (!typed) return;
    if (body.dataset.entrance) { sessionStorage.setItem("typed", JSON.stringify({ ...typed, entered: true })); return; }
    if (!body.dataset.live) return;
    sessionStorage.removeItem("typed");
    // Without a log-in in between the form was taken.
    if (!typed.entered || typed.who !== body.dataset.who) return;
    if (typed.path !== location.pathname) {
      if (typed.led) return;
      sessionStorage.setItem("typed", JSON.stringify({ ...typed, led: true }));
      location.replace(typed.path);
      return;
    }
    const now = fields();
    for (const [at, name, checked, value] of typed.rows) {
      if (now[at] && now[at].name === name) Object.assign(now[at], ["checkbox", "radio"].includes(now[at].type) ? { checked } : { value });
    }
    const note = document.createElement("p");
    note.className = "note";
    note.setAttribute("role", "status");
    note.textContent = body.dataset.kept;
    document.getElementById("main").prepend(note);
  }

  // A second press before the first one is answered would start the job twice.
  document.addEventListener("submit", (event) => {
    if (event.target.dataset.sent) { event.preventDefault(); return; }
    event.target.dataset.sent = "yes";
    if (body.dataset.live && event.target.closest("main")) keep();
    setTimeout(() => delete event.target.dataset.sent, 3000);
  });

  const here = document.querySelector("nav.pages [aria-current]");
  if (here) here.parentElement.scrollLeft = here.offsetLeft - 24;

  restore();
  if (body.dataset.live) { follow(); listen(); setInterval(look, 2000); }
})();
