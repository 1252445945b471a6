"use strict";
// Pictures of one scene, all showing the same part: drag, wheel (after a click) and keys move all of them together.
class Viewer {
  constructor(root, pictures, [width, height]) {
    Object.assign(this, { root, pictures, scale: 1, x: 0, y: 0, current: 0, hidden: new Set() });
    root.tabIndex = 0;
    root.style.setProperty("--single", Math.max(2 * width, 960) + "px");
    this.controls = root.appendChild(document.createElement("div"));
    this.controls.className = "controls";
    this.errors = this.check("error maps (E)", false, () => this.show());
    this.single = this.check("one at a time (1-9, ← →)", false, () => this.show());
    for (const [text, factor] of [["+", 2], ["−", 0.5]])
      this.button(text, () => this.zoom(0.5, 0.5, factor));
    this.button("whole picture (0)", () => this.reset());
    this.facets();
    this.size();
    const list = root.appendChild(document.createElement("div"));
    list.className = "pictures";
    this.figures = pictures.map((picture, k) => list.appendChild(this.figure(picture, k, width / height)));
    root.addEventListener("keydown", event => this.key(event));
    root.addEventListener("pointerleave", () => root.classList.remove("pointed"));
    this.show();
  }

  check(text, checked, changed, parent = this.controls) {
    const label = parent.appendChild(document.createElement("label"));
    const box = label.appendChild(document.createElement("input"));
    box.type = "checkbox";
    box.checked = checked;
    label.append(" " + text);
    box.addEventListener("change", () => changed(box.checked));
    return box;
  }

  button(text, clicked) {
    const button = this.controls.appendChild(document.createElement("button"));
    button.textContent = text;
    button.addEventListener("click", clicked);
  }

  // A row of boxes for each property by which pictures differ; a picture is shown if all of its own are ticked.
  facets() {
    for (const name of ["kind", "denoiser", "integrator"]) {
      const values = [...new Set(this.pictures.filter(p => p[name]).map(p => p[name]))];
      if (values.length < 2) continue;
      const facet = this.controls.appendChild(document.createElement("span"));
      facet.className = "facet";
      facet.appendChild(document.createElement("b")).textContent = name;
      const last = values.filter(v => !v.startsWith("sample")).pop();
      for (const value of values) {
        const key = name + ":" + value, ticked = name !== "kind" || value === last;
        if (!ticked) this.hidden.add(key);
        this.check(value, ticked, on => { this.hidden[on ? "delete" : "add"](key); this.show(); }, facet);
      }
    }
  }

  size() {
    const label = this.controls.appendChild(document.createElement("label"));
    label.append("size ");
    const range = label.appendChild(document.createElement("input"));
    Object.assign(range, { type: "range", min: 160, max: 960, step: 20, value: 320 });
    const set = () => this.root.style.setProperty("--width", range.value + "px");
    range.addEventListener("input", set);
    set();
  }

  figure(picture, k, aspect) {
    const figure = document.createElement("figure");
    const frame = figure.appendChild(document.createElement("div"));
    frame.className = "frame";
    frame.style.aspectRatio = aspect;
    frame.appendChild(new Image()).alt = picture.name;
    frame.appendChild(document.createElement("i"));
    const caption = figure.appendChild(document.createElement("figcaption"));
    caption.appendChild(document.createElement("b")).textContent = picture.name;
    caption.append(picture.caption);
    const place = event => {
      const box = frame.getBoundingClientRect();
      return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
    };
    let from = null;
    frame.addEventListener("pointerdown", event => {
      event.preventDefault();
      this.root.focus({ preventScroll: true });
      frame.setPointerCapture(event.pointerId);
      from = place(event);
      this.choose(k);
    });
    frame.addEventListener("pointermove", event => {
      const [x, y] = place(event);
      if (from) {
        this.move((from[0] - x) / this.scale, (from[1] - y) / this.scale);
        from = [x, y];
      }
      this.root.style.setProperty("--x", 100 * x + "%");
      this.root.style.setProperty("--y", 100 * y + "%");
      this.root.classList.add("pointed");
    });
    for (const end of ["pointerup", "pointercancel"]) frame.addEventListener(end, () => { from = null; });
    frame.addEventListener("dblclick", event => this.zoom(...place(event), event.shiftKey ? 0.5 : 2));
    frame.addEventListener("wheel", event => {
      if (!this.root.contains(document.activeElement) && !event.ctrlKey) return; // or the page could not be scrolled
      event.preventDefault();
      this.zoom(...place(event), Math.exp(-0.002 * event.deltaY));
    }, { passive: false });
    return figure;
  }

  zoom(x, y, factor) {
    const scale = Math.min(64, Math.max(1, this.scale * factor));
    this.x += x / this.scale - x / scale;
    this.y += y / this.scale - y / scale;
    this.scale = scale;
    this.move(0, 0);
  }

  move(dx, dy) {
    const most = 1 - 1 / this.scale;
    this.x = Math.min(most, Math.max(0, this.x + dx));
    this.y = Math.min(most, Math.max(0, this.y + dy));
    const transform = `scale(${this.scale}) translate(${-100 * this.x}%, ${-100 * this.y}%)`;
    for (const figure of this.figures) figure.querySelector("img").style.transform = transform;
    this.root.classList.toggle("near", this.scale > 1);
  }

  reset() {
    this.scale = 1;
    this.move(0, 0);
  }

  shown() {
    const ticked = p => ["kind", "denoiser", "integrator"].every(name => !this.hidden.has(name + ":" + p[name]));
    return this.pictures.map((p, k) => k).filter(k => ticked(this.pictures[k]));
  }

  show() {
    const shown = this.shown();
    if (!shown.includes(this.current)) this.current = shown[0] ?? 0;
    this.figures.forEach((figure, k) => {
      const picture = this.pictures[k];
      figure.hidden = !shown.includes(k) || (this.single.checked && k !== this.current);
      figure.classList.toggle("current", k === this.current && !this.single.checked);
      const source = this.errors.checked && picture.error ? picture.error : picture.image;
      const image = figure.querySelector("img");
      if (!figure.hidden && image.src !== source) image.src = source;
    });
    this.root.classList.toggle("single", this.single.checked);
  }

  choose(k) {
    this.current = k;
    this.show();
  }

  key(event) {
    if (event.target !== this.root || event.ctrlKey || event.metaKey || event.altKey) return;
    const shown = this.shown(), at = shown.indexOf(this.current), digit = Number(event.key);
    if (digit >= 1 && digit <= shown.length) this.choose(shown[digit - 1]);
    else if (event.key === "ArrowRight") this.choose(shown[(at + 1) % shown.length]);
    else if (event.key === "ArrowLeft") this.choose(shown[(at + shown.length - 1) % shown.length]);
    else if (event.key === "+" || event.key === "=") this.zoom(0.5, 0.5, 2);
    else if (event.key === "-") this.zoom(0.5, 0.5, 0.5);
    else if (event.key === "0") this.reset();
    else if (event.key === "e" || event.key === "E") {
      this.errors.checked = !this.errors.checked;
      this.show();
    } else return;
    event.preventDefault();
  }
}

for (const [k, scene] of JSON.parse(document.getElementById("pictures").textContent).entries())
  if (scene.pictures.length) new Viewer(document.getElementById("viewer-" + k), scene.pictures, scene.size);
