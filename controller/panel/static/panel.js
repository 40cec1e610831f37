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
    if (link) link.textContent = text;
  }

  function listen() {
    const source = new EventSource(body.dataset.live);
    source.addEventListener("open", () => say(""));
    source.addEventListener("parts", (event) => draw(JSON.parse(event.data)));
    source.addEventListener("reload", () => { source.close(); listen(); });
    source.addEventListener("full", () => say(body.dataset.full));
    source.addEventListener("error", () => {
      say(body.dataset.lost);
      if (source.readyState === EventSource.CLOSED) {
        // Refused: the session has ended, or the service is starting.
        setTimeout(async () => {
          try {
            const answer = await fetch(body.dataset.live, { method: "HEAD", redirect: "manual" });
            if (answer.status === 401 || answer.type === "opaqueredirect") { location.assign("/login"); return; }
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
  for (const place of document.querySelectorAll("[data-late]")) late(place);

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

  // A second press before the first one is answered would start the job twice.
  document.addEventListener("submit", (event) => {
    if (event.target.dataset.sent) { event.preventDefault(); return; }
    event.target.dataset.sent = "yes";
    setTimeout(() => delete event.target.dataset.sent, 3000);
  });

  const here = document.querySelector("nav.pages [aria-current]");
  if (here) here.parentElement.scrollLeft = here.offsetLeft - 24;

  if (body.dataset.live) { follow(); listen(); setInterval(look, 2000); }
})();
