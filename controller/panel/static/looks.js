"use strict";
// What is looked at: two pictures with a line between them, an outline on the object, and the live view's sharpness.
(() => {
  for (const wipe of document.querySelectorAll("[data-wipe]")) {
    const over = wipe.querySelector(".over"), under = wipe.querySelector(".under"), range = wipe.querySelector("input");
    const cut = () => over.style.setProperty("clip-path", `inset(0 0 0 ${range.value}%)`);
    range.addEventListener("input", cut);
    const buttons = [...wipe.querySelectorAll("[data-under]")];
    for (const button of buttons) {
      button.addEventListener("click", () => {
        under.src = button.dataset.under;
        under.alt = button.dataset.alt;
        for (const one of buttons) one.setAttribute("aria-pressed", String(one === button));
      });
    }
    cut();
    wipe.hidden = false;
  }

  function outline(place) {
    const field = place.querySelector("#outline"), svg = place.querySelector("#draw");
    let regions = [];
    const draw = () => {
      field.value = JSON.stringify(regions.filter((one) => one.length > 2));
      svg.replaceChildren(...regions.flatMap((region) => {
        const shape = document.createElementNS(svg.namespaceURI, "polygon");
        shape.setAttribute("points", region.map(([x, y]) => `${1000 * x},${1000 * y}`).join(" "));
        return [shape, ...region.map(([x, y]) => {
          const corner = document.createElementNS(svg.namespaceURI, "ellipse");
          const box = svg.getBoundingClientRect();
          for (const [name, value] of [["cx", 1000 * x], ["cy", 1000 * y], ["rx", 5000 / box.width], ["ry", 5000 / box.height]]) corner.setAttribute(name, value);
          return corner;
        })];
      }));
    };
    const typed = () => {
      try { regions = JSON.parse(field.value || "[]"); } catch { return; }
      if (Array.isArray(regions)) draw();
    };
    svg.addEventListener("click", (event) => {
      const box = svg.getBoundingClientRect();
      const inside = (value) => Math.round(1e4 * Math.min(1, Math.max(0, value))) / 1e4;
      if (!regions.length) regions.push([]);
      regions[regions.length - 1].push([inside((event.clientX - box.left) / box.width), inside((event.clientY - box.top) / box.height)]);
      draw();
    });
    place.querySelector("#region").addEventListener("click", () => { if (!regions.length || regions[regions.length - 1].length > 2) regions.push([]); });
    place.querySelector("#undo").addEventListener("click", () => {
      while (regions.length && !regions[regions.length - 1].length) regions.pop();
      if (regions.length) regions[regions.length - 1].pop();
      draw();
    });
    place.querySelector("#clear").addEventListener("click", () => { regions = []; draw(); });
    field.addEventListener("change", typed);
    for (const hidden of [place, ...place.querySelectorAll("[hidden]")]) hidden.hidden = false;
    if (place.querySelector(".over")) blinking(place);
    typed();
  }
  // One picture over another.
  function blinking(place) {
    const over = place.querySelector(".over"), through = place.querySelector("#through");
    const fade = () => over.style.setProperty("opacity", String(through.value / 100));
    through.addEventListener("input", fade);
    fade();
  }
  // The chosen picture in the camera's view, in each of the ways to fit it, as small as the drawings of them.
  function fit(ways, picture) {
    const [width, height] = ways.dataset.view.split(" ").map(Number), WIDE = 80, high = WIDE * height / width;
    for (const input of ways.querySelectorAll("input")) {
      const canvas = input.parentElement.querySelector("canvas"), paper = canvas.getContext("2d");
      const across = WIDE / picture.width, down = high / picture.height;
      const scale = { fit: Math.min(across, down), crop: WIDE / width }[input.value] || Math.max(across, down);
      paper.setTransform(canvas.width / 96, 0, 0, canvas.height / 80, 0, 0);
      paper.clearRect(0, 0, 96, 80);
      paper.save();
      paper.beginPath();
      paper.rect(8, 40 - high / 2, WIDE, high);
      paper.clip();
      if (input.value === "wrap") paper.clip(new Path2D(canvas.parentElement.querySelector("path").getAttribute("d")));
      paper.drawImage(picture, 48 - scale * picture.width / 2, 40 - scale * picture.height / 2, scale * picture.width, scale * picture.height);
      paper.restore();
      canvas.hidden = false;
    }
  }
  const file = document.getElementById("file"), ways = document.querySelector(".ways");
  if (file && ways) file.addEventListener("change", async () => {
    const picture = file.files[0] && await createImageBitmap(file.files[0]).catch(() => null);
    if (picture) fit(ways, picture);
    else for (const canvas of ways.querySelectorAll("canvas")) canvas.hidden = true;
  });

  // Places in a picture, and the same ones on the object, with a loupe on the last one.
  function pairs(place) {
    const form = place.querySelector("form"), field = form.elements.points, sides = [...place.querySelectorAll(".overlay")];
    const loupe = place.querySelector("canvas"), points = [[], []], order = [], WIDE = 20;
    const put = (side) => {
      const lost = points[side].length - 1, image = sides[side].querySelector("img");
      field.value = JSON.stringify(points[0].slice(0, points[1].length).map((at, n) => [...at, ...points[1][n]]));
      form.querySelector(".main").disabled = Math.min(points[0].length, points[1].length) < 4 || points[0].length !== points[1].length;
      sides[side].querySelector("svg").replaceChildren(...points[side].flatMap(([x, y], n) => {
        const [cross, label] = ["path", "text"].map((name) => document.createElementNS("http://www.w3.org/2000/svg", name));
        cross.setAttribute("d", `M${1000 * x - 14} ${1000 * y}h28m-14 -21v42`);
        label.setAttribute("x", 1000 * x + 16);
        label.setAttribute("y", 1000 * y - 12);
        label.textContent = String(n + 1);
        return [cross, label];
      }));
      const paper = loupe.getContext("2d");
      paper.fillRect(0, 0, loupe.width, loupe.height);
      if (lost < 0) return;
      const [x, y] = points[side][lost], half = WIDE / 2, scale = loupe.width / WIDE;
      paper.imageSmoothingEnabled = false;
      paper.drawImage(image, x * image.naturalWidth - half, y * image.naturalHeight - half, WIDE, WIDE, 0, 0, loupe.width, loupe.height);
      paper.strokeStyle = "#ff3b30";
      paper.strokeRect((half - 0.5) * scale, (half - 0.5) * scale, scale, scale);
    };
    const inside = (value) => Math.round(1e6 * Math.min(1, Math.max(0, value))) / 1e6;
    const add = (side, x, y) => { points[side].push([inside(x), inside(y)]); order.push(side); put(side); };
    sides.forEach((side, n) => {
      const image = side.querySelector("img");
      side.addEventListener("click", (event) => {
        const box = image.getBoundingClientRect();
        add(n, (event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height);
      });
      side.addEventListener("keydown", (event) => {
        const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key], last = points[n].at(-1);
        if (event.key === "Enter") add(n, 0.5, 0.5);
        else if (way && last) {
          const by = event.shiftKey ? 10 : 1;
          last[0] = inside(last[0] + by * way[0] / image.naturalWidth);
          last[1] = inside(last[1] + by * way[1] / image.naturalHeight);
          put(n);
        } else return;
        event.preventDefault();
      });
    });
    place.querySelector("#point-back").addEventListener("click", () => {
      const side = order.pop();
      if (side === undefined) return;
      points[side].pop();
      put(side);
    });
    place.hidden = false;
  }
  const place = document.getElementById("on-object"), byPoints = document.getElementById("by-points"), laid = document.getElementById("laid");
  if (laid) blinking(laid);
  if (place && place.querySelector("#draw")) outline(place);
  if (byPoints) pairs(byPoints);

  // Of the live picture, as small as the eye needs: the energy of its edges, and how many pixels have which level.
  const live = document.getElementById("live-view"), camera = document.getElementById("camera");
  if (!live || !camera) return;
  const history = [], WIDE = 320, KEPT = 60;
  const canvas = document.createElement("canvas");
  function measure(picture) {
    canvas.width = WIDE;
    canvas.height = Math.max(3, Math.round(WIDE * picture.naturalHeight / picture.naturalWidth));
    const paper = canvas.getContext("2d", { willReadFrequently: true });
    paper.drawImage(picture, 0, 0, canvas.width, canvas.height);
    const { data, width, height } = paper.getImageData(0, 0, canvas.width, canvas.height);
    const grey = new Float32Array(width * height), levels = new Float32Array(32);
    let clipped = 0;
    for (let n = 0; n < grey.length; n += 1) {
      const top = Math.max(data[4 * n], data[4 * n + 1], data[4 * n + 2]);
      grey[n] = (data[4 * n] + data[4 * n + 1] + data[4 * n + 2]) / 3;
      levels[top >> 3] += 1;
      if (top >= 250) clipped += 1;
    }
    let edges = 0, light = 0;
    for (let y = 1; y < height - 1; y += 1) {
      for (let x = 1; x < width - 1; x += 1) {
        const n = y * width + x;
        edges += (4 * grey[n] - grey[n - 1] - grey[n + 1] - grey[n - width] - grey[n + width]) ** 2;
        light += grey[n] ** 2;
      }
    }
    return { sharp: light > 0 ? edges / light : 0, levels, clipped: clipped / grey.length };
  }
  camera.addEventListener("seen", (event) => {
    const found = measure(event.detail);
    history.push(found.sharp);
    if (history.length > KEPT) history.shift();
    const best = Math.max(...history) || 1, most = Math.max(...found.levels) || 1;
    live.querySelector("polyline").setAttribute("points", history.map((value, n) => `${(300 * n / (KEPT - 1)).toFixed(1)},${(86 - 80 * value / best).toFixed(1)}`).join(" "));
    live.querySelector("#levels path").setAttribute("d", [...found.levels].map((count, n) => `${n ? "" : "M0 90"}V${(90 - 84 * Math.sqrt(count / most)).toFixed(1)}H${(300 * (n + 1) / 32).toFixed(1)}`).join("") + "V90Z");
    const percent = new Intl.NumberFormat(document.documentElement.lang, { style: "percent", maximumFractionDigits: 1 });
    live.querySelector("#sharp-now").textContent = percent.format(found.sharp / best);
    live.querySelector("#clipped").textContent = percent.format(found.clipped);
    live.hidden = false;
  });
})();
