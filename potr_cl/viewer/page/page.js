// What the viewer adds to viser's page: the divider, labels, figures, the list of views, files that are dropped.
// Names come from files that strangers wrote: they are only ever set as textContent.
(() => {
  "use strict";
  // viser's page says at most every 20 ms where its camera is, fewer times than screens show pictures. Its other waits of
  // this length are for the mouse, and as well shorter.
  const later = window.setTimeout.bind(window);
  window.setTimeout = (work, wait, ...rest) => later(work, wait === 20 ? 15 : wait, ...rest);

  const state = { mode: "divider", divider: 0.5, pair: false, labels: null, figures: null, scenes: [], views: [],
    at: null, ladder: null, error: "", heat: null, drawable: null, background: "#000" };
  let socket = null, key = null, dragging = false, sending = null, swapped = false;
  let asked = 0;  // how often a rung of the ladder was asked for on this connection

  const made = (tag, name, text) => {
    const element = document.createElement(tag);
    if (name) element.className = name;
    if (text !== undefined) element.textContent = text;
    return element;
  };
  const say = message => { if (socket && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message)); };
  const climb = rung => {
    state.ladder.at = Math.min(Math.max(rung, 0), state.ladder.rungs.length - 1);
    say({ rung: state.ladder.at, asked: ++asked });
  };

  // Over the picture ------------------------------------------------------------------------------------------------
  const stage = made("div", "potr-stage");
  const labels = [made("div", "potr-label left"), made("div", "potr-label right")];
  const line = made("div", "potr-line");
  const grip = made("button", "potr-grip");
  grip.setAttribute("role", "slider");
  grip.setAttribute("aria-label", "divider between A and B");
  stage.append(...labels, line, grip);
  const ground = made("canvas", "potr-ground");  // what this browser draws
  ground.hidden = true;

  function divide(at) {
    state.divider = Math.min(Math.max(at, 0), 1);
    place();
    redraw();
    if (sending === null) {
      sending = requestAnimationFrame(() => { sending = null; say({ divider: state.divider }); });
    }
  }
  grip.addEventListener("pointerdown", event => {
    dragging = true;
    grip.setPointerCapture(event.pointerId);
    event.preventDefault();
    event.stopPropagation();
    grip.focus();
  });
  grip.addEventListener("pointermove", event => {
    if (!dragging) return;
    const box = stage.getBoundingClientRect();
    divide((event.clientX - box.left) / box.width);
  });
  for (const end of ["pointerup", "pointercancel"]) grip.addEventListener(end, () => { dragging = false; });
  grip.addEventListener("keydown", event => {
    const step = { ArrowLeft: -0.02, ArrowRight: 0.02, Home: -1, End: 1 }[event.key];
    if (step === undefined) return;
    divide(state.divider + step);
    event.preventDefault();
    event.stopPropagation();
  });

  function place() {
    const halved = way === "both" && !ground.hidden;
    const divider = (state.pair && state.mode === "divider") || (halved && state.mode !== "side by side");
    const middle = state.pair && state.mode === "side by side";
    const at = middle ? 0.5 : state.divider;
    for (const element of [line, grip]) element.style.left = `${100 * at}%`;
    line.hidden = !(divider || middle);
    grip.hidden = !divider;
    grip.setAttribute("aria-valuenow", String(Math.round(100 * at)));
    let [left, right] = state.labels || ["", ""];
    if (halved) [left, right] = [[left, WAYS.here], [right || left, WAYS.exact]].map(words => words.filter(Boolean).join(", "));
    ground.style.clipPath = halved ? `inset(0 ${100 - 100 * at}% 0 0)` : "";
    ground.classList.toggle("above", halved);
    labels[0].textContent = left;
    labels[1].textContent = right;
    labels[0].hidden = !left;
    labels[1].hidden = !right;
    // Beside the divider, not under viser's panel.
    const width = stage.clientWidth || 1;
    labels[1].style.left = right ? `${Math.min(100 * at, 100 - 100 * 160 / width)}%` : "";
    labels[1].style.right = right ? "auto" : "";
    labels[1].style.marginLeft = "12px";
  }

  // Drawn here ------------------------------------------------------------------------------------------------------
  // This browser draws scenes beneath viser's picture. The server's exact picture is that picture: it hides what is
  // drawn here, until the server is told that nobody needs it.
  const WAYS = { here: "your GPU", exact: "exact", both: "both" };
  const gl = document.createElement("canvas").getContext("webgl2");
  const about = gl && gl.getParameter(gl.getExtension("WEBGL_debug_renderer_info")?.UNMASKED_RENDERER_WEBGL ?? gl.RENDERER);
  let way = /swiftshader|llvmpipe|software|basic render/i.test(about) ? "exact" : "here";
  let view = null, drawing = null, awaited = null, frame = null, draws = false;
  const there = {};  // the numbers of the scenes that can be drawn

  // What viser's page tells its server of the camera.
  const post = Worker.prototype.postMessage;
  Worker.prototype.postMessage = function (data, ...rest) {
    if (data?.message?.type === "ViewerCameraMessage") {
      view = data.message;
      redraw();
    }
    return post.call(this, data, ...rest);
  };

  function choose(chosen) {
    way = chosen;
    refresh(["drawn"]);
    fetchScenes();
    redraw();
  }
  function parts() {
    const [left, right] = swapped ? "BA" : "AB", only = Object.keys(state.drawable);
    if (only.length === 1) return [[only[0], 0, 1, 0, 1]];
    return { divider: [[left, 0, 1, 0, state.divider], [right, 0, 1, state.divider, 1]], A: [[left, 0, 1, 0, 1]],
      "side by side": [[left, 0, 0.5, 0, 0.5], [right, 0.5, 1, 0.5, 1]], B: [[right, 0, 1, 0, 1]] }[state.mode];
  }
  function redraw() {
    frame ??= requestAnimationFrame(() => {
      frame = null;
      const shown = way !== "exact" && view && state.drawable && Object.keys(state.drawable).every(which => there[which])
        && parts();
      if (shown) drawing.draw(view, shown);
      ground.hidden = !shown;
      document.body.dataset.drawn = shown ? way : "";
      place();
      const now = Boolean(shown) && way === "here";
      if (now !== draws) say({ draws: draws = now });
    });
  }
  function fetchScenes() {
    if (awaited || !state.drawable || way === "exact" || !gl) return;
    const missing = Object.entries(state.drawable).find(([which, number]) => there[which] !== number);
    if (!missing) return;
    awaited = { which: missing[0], number: missing[1], parts: [], left: 0 };
    say({ scene: missing[1] });
  }
  async function arrived({ which, number, parts }) {
    try {
      if (!globalThis.potr) await new Promise((done, failed) => {
        const script = made("script");
        Object.assign(script, { src: "/potr_cl/viewer.js", onload: done, onerror: () => failed(new Error("it did not load")) });
        document.head.append(script);
      });
      drawing ??= await potr.drawing(ground, state.background, () => giveUp("the GPU is gone"));
      await drawing.put(which, new Uint8Array(await new Blob(parts).arrayBuffer()));
      there[which] = number;
    } catch (error) {
      giveUp(error.message);
    }
    awaited = null;
    fetchScenes();
    redraw();
  }
  function giveUp(why) {
    inform(`this browser cannot draw the scene: ${why}`, true);
    choose("exact");
  }

  // In the panel ------------------------------------------------------------------------------------------------------
  const fill = {
    error(box) {
      box.className = state.error ? "potr-error" : "potr-box";
      box.textContent = state.error;
    },
    scenes(box) {
      for (const scene of state.scenes) {
        const row = made("div", "potr-scene"), text = made("div");
        const name = made("span", "", scene.name);
        name.title = scene.name;
        text.append(name, made("small", "", scene.size));
        row.append(...(scene.which ? [made("b", "", scene.which)] : []), text);
        box.append(row);
      }
      if (state.note) box.append(made("div", "potr-note", state.note));
    },
    figures(box) {
      if (!state.figures) return;
      const row = made("div", state.figures.old ? "potr-figures old" : "potr-figures");
      for (const [name, value] of state.figures.values) {
        const cell = made("div");
        cell.append(made("small", "", name), made("b", "", value));
        row.append(cell);
      }
      box.append(row);
      if (state.heat) {
        box.append(made("div", "potr-scale"));
        const ends = made("div", "potr-ends");
        ends.append(made("span", "", "equal"), made("span", "", state.heat));
        box.append(ends);
      }
      if (state.figures.note) box.append(made("div", "potr-note", state.figures.note));
    },
    drawn(box) {
      if (!state.drawable || !gl) return;
      const row = made("div", "potr-ways", "drawn by ");
      row.title = "key X: your GPU, or the exact picture; both: one beside the other under the divider";
      for (const [name, words] of Object.entries(WAYS)) {
        const button = made("button", "", words);
        button.setAttribute("aria-pressed", String(name === way));
        button.addEventListener("click", () => choose(name));
        row.append(button);
      }
      box.append(row);
    },
    curve(box) {
      if (state.ladder && state.ladder.rungs.some(rung => rung.psnr !== null)) box.append(curve(state.ladder));
    },
    views(box) {
      if (!state.views.length) return;
      box.append(made("div", "potr-note", state.viewsNote || ""));
      const list = made("div", "potr-views");
      for (const view of state.views) {
        const row = made("button", view.n === state.at ? "at" : "");
        row.dataset.view = view.n;
        const name = made("span", "", view.name);
        row.title = view.name + (view.test ? " (test view)" : " (training view)");
        row.append(made("i", view.test ? "test" : ""), name, made("small", "", view.text));
        row.addEventListener("click", () => say({ fly: view.n }));
        list.append(row);
      }
      box.append(list);
    },
  };

  function curve(ladder) {
    const width = 260, height = 120, left = 50, bottom = 22, svgNs = "http://www.w3.org/2000/svg";
    const node = (tag, attributes, text) => {
      const element = document.createElementNS(svgNs, tag);
      for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
      if (text !== undefined) element.textContent = text;
      return element;
    };
    const svg = node("svg", { class: "potr-curve", viewBox: `0 0 ${width} ${height}`, role: "img",
      "aria-label": "PSNR by size" });
    const rungs = ladder.rungs.filter(rung => rung.psnr !== null);
    if (rungs.length) {
      const bytes = rungs.map(rung => Math.log(Math.max(rung.bytes, 1))), psnr = rungs.map(rung => rung.psnr);
      const span = values => [Math.min(...values), Math.max(...values)];
      const [b0, b1] = span(bytes), [p0, p1] = span(psnr);
      const x = value => left + (width - left - 12) * (b1 > b0 ? (value - b0) / (b1 - b0) : 0.5);
      const y = value => height - bottom - 4 - (height - bottom - 18) * (p1 > p0 ? (value - p0) / (p1 - p0) : 0.5);
      svg.append(node("text", { x: 0, y: y(p1) + 4 }, `${p1.toFixed(1)} dB`));
      if (p1 > p0) svg.append(node("text", { x: 0, y: y(p0) + 4 }, `${p0.toFixed(1)} dB`));
      svg.append(node("text", { x: x(b0), y: height - 4, "text-anchor": "start" }, rungs[0].size));
      if (b1 > b0) svg.append(node("text", { x: x(b1), y: height - 4, "text-anchor": "end" }, rungs[rungs.length - 1].size));
      svg.append(node("path", { d: rungs.map((rung, k) => `${k ? "L" : "M"}${x(bytes[k])} ${y(psnr[k])}`).join("") }));
      rungs.forEach((rung, k) => {
        const dot = node("circle", { cx: x(bytes[k]), cy: y(psnr[k]), r: rung.n === ladder.at ? 6 : 4,
          class: rung.n === ladder.at ? "at" : "" });
        dot.append(node("title", {}, `q ${rung.q}: ${rung.size}, ${rung.psnr.toFixed(2)} dB`));
        dot.addEventListener("click", () => climb(rung.n));
        svg.append(dot);
      });
    }
    return svg;
  }

  // What is pressed in the panel is not made anew before it is let go: a click needs the same element at both ends.
  let pressed = false;
  const waiting = new Set();
  window.addEventListener("pointerdown", event => {
    pressed = event.target instanceof Element && event.target.closest("[data-potr]") !== null;
  }, true);
  for (const end of ["pointerup", "pointercancel"])
    window.addEventListener(end, () => setTimeout(() => {  // behind the click
      pressed = false;
      if (waiting.size) refresh([...waiting]);
      waiting.clear();
    }), true);

  function refresh(names) {
    const focused = document.activeElement?.dataset.view;
    for (const box of document.querySelectorAll("[data-potr]")) {
      const name = box.dataset.potr;
      if (!fill[name] || (names && !names.includes(name) && box.dataset.filled)) continue;
      if (pressed && box.dataset.filled) {
        waiting.add(name);
        continue;
      }
      const list = box.querySelector(".potr-views"), scrolled = list ? list.scrollTop : 0;
      box.replaceChildren();
      fill[name](box);
      box.dataset.filled = "yes";
      if (scrolled) box.querySelector(".potr-views").scrollTop = scrolled;
    }
    if (focused !== undefined && !document.activeElement?.dataset.view) {
      const row = document.querySelector(`[data-view="${focused}"]`);
      if (row) row.focus({ preventScroll: true });
    }
  }

  const PARTS = { error: ["error"], scenes: ["scenes"], note: ["scenes"], figures: ["figures"], heat: ["figures"],
    ladder: ["curve"], drawable: ["drawn"], views: ["views"], viewsNote: ["views"], at: ["views"] };

  // The channel -------------------------------------------------------------------------------------------------------
  function connect() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    asked = 0;
    draws = false;
    awaited = null;
    socket = new WebSocket(`${scheme}://${location.host}/potr_cl/channel?key=${encodeURIComponent(key)}`);
    socket.binaryType = "arraybuffer";
    socket.addEventListener("message", event => {
      if (event.data instanceof ArrayBuffer) {
        awaited.parts.push(event.data);
        if (!(awaited.left -= event.data.byteLength)) arrived(awaited);
        return;
      }
      const message = JSON.parse(event.data);
      if (message.scene?.error) {
        awaited = null;
        giveUp(message.scene.error);
      } else if (message.scene) awaited.left = message.scene.bytes;
      if (message.state) {
        if (dragging) delete message.state.divider;
        // Told before the last key was known there: the key counts.
        if (message.state.ladder && state.ladder && message.state.asked < asked) message.state.ladder.at = state.ladder.at;
        const changed = Object.keys(message.state).filter(
          name => JSON.stringify(message.state[name]) !== JSON.stringify(state[name]));
        Object.assign(state, message.state);
        place();
        fetchScenes();
        redraw();
        document.title = [...state.scenes.map(scene => scene.name), "potr_cl"].join(" – ");
        refresh([...new Set(changed.flatMap(name => PARTS[name] || []))]);
        if (window.parent !== window) window.parent.postMessage("potr_cl viewer", "*");
      }
      if (message.upload) told(message.upload);
    });
  }

  function settle() {
    const canvas = document.querySelector("canvas");
    if (canvas && stage.parentElement !== canvas.parentElement) {
      canvas.parentElement.classList.add("potr-field");
      canvas.parentElement.append(ground, stage);
      place();
    }
    const holder = document.querySelector("[data-potr-key]");
    if (holder && holder.dataset.potrKey !== key) {
      key = holder.dataset.potrKey;
      if (socket) socket.close();
      connect();
    }
    // What holds the panel on a phone.
    let sheet = document.querySelector("[data-potr=scenes]");
    while (sheet && sheet.style.maxHeight !== "60%") sheet = sheet.parentElement;
    if (sheet) sheet.classList.add("potr-sheet");
    refresh([]);
  }
  let settling = false;
  new MutationObserver(() => {
    if (settling) return;
    settling = true;
    requestAnimationFrame(() => { settling = false; settle(); });
  }).observe(document, { childList: true, subtree: true });

  // Keys --------------------------------------------------------------------------------------------------------------
  const typing = target => target.closest && target.closest(
    "input:not([type=checkbox], [type=range], [type=radio]), textarea, select, [contenteditable]");
  const modes = { 1: "divider", 2: "side by side", 3: "A", 4: "B", 5: "difference", 6: "heat map" };
  const flick = on => { if (on !== swapped) { swapped = on; say({ swap: on }); redraw(); } };
  addEventListener("keydown", event => {
    if (event.ctrlKey || event.metaKey || event.altKey || typing(event.target)) return;
    if (event.key === "f" || event.key === "F") flick(true);
    else if ((event.key === "x" || event.key === "X") && !event.repeat) choose(way === "exact" ? "here" : "exact");
    else if ((event.key === "c" || event.key === "C") && !event.repeat) say({ cameras: true });
    else if (modes[event.key] && !event.repeat) say({ mode: modes[event.key] });
  });
  // Sliders: viser would turn the camera by the same keys, and the one of qualities has steps that are no files.
  const sliderOf = event => event.target instanceof Element && event.target.closest("[role=slider]:not(.potr-grip)");
  addEventListener("keydown", event => {
    const slider = sliderOf(event), after = document.querySelector("[data-potr=curve]");
    if (!slider || !state.ladder || !after || !(slider.compareDocumentPosition(after) & Node.DOCUMENT_POSITION_FOLLOWING))
      return;
    const last = state.ladder.rungs.length - 1, at = state.ladder.at;
    const rung = { ArrowLeft: at - 1, ArrowDown: at - 1, ArrowRight: at + 1, ArrowUp: at + 1, Home: 0, End: last }[event.key];
    if (rung === undefined) return;
    event.preventDefault();
    event.stopPropagation();
    climb(rung);
  }, true);
  const quiet = event => { if (sliderOf(event) && event.key.startsWith("Arrow")) event.stopPropagation(); };
  addEventListener("keyup", event => { if (event.key === "f" || event.key === "F") flick(false); });
  addEventListener("blur", () => flick(false));

  // Files that are dropped --------------------------------------------------------------------------------------------
  const zones = made("div", "potr-drop"), toast = made("div", "potr-toast");
  toast.setAttribute("role", "status");
  for (const [which, what] of [["A", "the reference"], ["B", "to compare with A"]]) {
    const zone = made("div");
    const text = made("span", "", `Show as ${which}`);
    text.append(made("small", "", what));
    zone.append(text);
    zone.dataset.as = which;
    zone.addEventListener("dragover", event => { event.preventDefault(); zone.classList.add("over"); });
    zone.addEventListener("dragleave", () => zone.classList.remove("over"));
    zones.append(zone);
  }
  let upload = null, hiding = null;
  const brings = event => event.dataTransfer && [...event.dataTransfer.types].includes("Files");
  addEventListener("dragenter", event => { if (brings(event)) zones.classList.add("open"); });
  addEventListener("dragover", event => { if (brings(event)) event.preventDefault(); });
  addEventListener("dragleave", event => { if (!event.relatedTarget) zones.classList.remove("open"); });
  addEventListener("drop", event => {
    if (!brings(event)) return;
    event.preventDefault();
    zones.classList.remove("open");
    for (const zone of zones.children) zone.classList.remove("over");
    const zone = event.target.closest && event.target.closest("[data-as]");
    const file = event.dataTransfer.files[0];
    if (event.dataTransfer.files.length > 1) return inform("drop one file at a time", true);
    if (!file) return;
    if (upload) return inform("another file is on its way: wait until it is there", true);
    if (!socket || socket.readyState !== WebSocket.OPEN) return inform("the viewer has ended: start it again", true);
    upload = { file, sent: 0 };
    inform(`${file.name}: on its way`);
    say({ file: { name: file.name, size: file.size, as: zone ? zone.dataset.as : "B" } });
  });

  const PART = 1 << 20;
  async function deliver() {
    const mine = upload;
    while (upload === mine && mine.sent < mine.file.size) {
      if (socket.bufferedAmount > 8 * PART) { await new Promise(done => setTimeout(done, 20)); continue; }
      let part;
      try {
        part = await mine.file.slice(mine.sent, mine.sent + PART).arrayBuffer();
      } catch {
        upload = null;
        say({ cancel: true });
        return inform(`${mine.file.name}: the browser cannot read it; drop a file, not a folder`, true);
      }
      if (upload !== mine) return;
      socket.send(part);
      mine.sent += part.byteLength;
    }
  }
  function told(news) {
    if (news.ready) { if (upload) deliver(); return; }
    if (news.error) { upload = null; inform(news.error, true); }
    else if (news.shown) { upload = null; inform(news.shown); }
    else if (news.reading) inform(`${news.reading}: being read`, false, true);
    else if (news.size) inform(`${news.name}: ${Math.round(100 * news.received / news.size)} %`, false, true);
  }
  function inform(text, bad, stays) {
    toast.textContent = text;
    toast.classList.toggle("bad", Boolean(bad));
    toast.classList.add("open");
    clearTimeout(hiding);
    if (!stays) hiding = setTimeout(() => toast.classList.remove("open"), bad ? 12000 : 4000);
  }

  const begin = () => {
    document.body.append(zones, toast);
    document.body.addEventListener("keydown", quiet);  // behind the slider, before the camera
    settle();
  };
  if (document.body) begin(); else addEventListener("DOMContentLoaded", begin);
})();
