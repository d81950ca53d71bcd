// The photograph with the model on it: zoom, pan, handles, the magnifier. Pixels are those of the photograph; (0, 0) is
// the middle of the top-left one.

const NEAR = 11, NEAR_LINE = 8; // CSS px within which the pointer has hold of something
const LENS = 5; // times that the magnifier enlarges what is on the screen

export class View {
  constructor(stage, canvas, lens, act) {
    Object.assign(this, { stage, canvas, lens, act });
    this.context = canvas.getContext("2d");
    this.picture = null;
    this.size = [1, 1];
    this.scale = 1;
    this.left = this.top = 0;
    this.model = { lines: {}, points: {}, feet: [] };
    this.clicks = []; // { what, name, number, x, y, off, against }
    this.layers = []; // other models: { lines, colour }
    this.shapes = []; // advice: { label, pixels }
    this.strokes = []; // residuals: [x, y, dx, dy, out]
    this.regions = [];
    this.selected = null;
    this.hovered = null;
    this.tool = null; // "mask" or "goal"
    this.hold = null;
    this.pointer = null;
    this.fitted = true;
    new ResizeObserver(() => (this.fitted ? this.fit() : this.draw())).observe(stage);
    canvas.addEventListener("pointerdown", event => this.down(event));
    canvas.addEventListener("pointermove", event => this.move(event));
    canvas.addEventListener("pointerup", event => this.up(event));
    canvas.addEventListener("pointercancel", () => { this.hold = null; this.draw(); });
    canvas.addEventListener("pointerleave", () => { this.pointer = null; this.hovered = null; this.draw(); });
    canvas.addEventListener("wheel", event => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0016)), ...this.at(event));
    }, { passive: false });
  }

  show(picture, size) {
    const other = size[0] !== this.size[0] || size[1] !== this.size[1];
    [this.picture, this.size] = [picture, size];
    if (other) this.fit();
    this.draw();
  }

  // ---- places ----

  at(event) {
    const box = this.canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }
  screen([x, y]) { return [(x + 0.5) * this.scale + this.left, (y + 0.5) * this.scale + this.top]; }
  pixel(x, y) { return [(x - this.left) / this.scale - 0.5, (y - this.top) / this.scale - 0.5]; }
  get sigma() { return Math.min(Math.max(3 / this.scale, 1), 15); } // a hand is good to 3 px of the screen

  fit() {
    const { clientWidth: w, clientHeight: h } = this.stage;
    this.scale = Math.min(w / this.size[0], h / this.size[1]) * 0.94 || 1;
    this.left = (w - this.size[0] * this.scale) / 2;
    this.top = (h - this.size[1] * this.scale) / 2;
    this.fitted = true;
    this.draw();
  }
  zoom(factor, x = this.stage.clientWidth / 2, y = this.stage.clientHeight / 2) {
    const scale = Math.min(Math.max(this.scale * factor, 0.02), 60);
    this.left = x - (x - this.left) * scale / this.scale;
    this.top = y - (y - this.top) * scale / this.scale;
    this.scale = scale;
    this.fitted = false;
    this.draw();
  }
  pan(x, y) { this.left += x; this.top += y; this.fitted = false; this.draw(); }
  bring(place) { // into the middle, if it is out of sight
    const [x, y] = this.screen(place), { clientWidth: w, clientHeight: h } = this.stage;
    if (x < 20 || y < 20 || x > w - 20 || y > h - 20) this.pan(w / 2 - x, h / 2 - y);
  }

  // What the pointer has hold of: something shown, else a corner of the model, else a line of it.
  handle([x, y]) {
    let best = null, least = NEAR;
    const take = (place, found) => {
      const [a, b] = this.screen(place), apart = Math.hypot(a - x, b - y);
      if (apart < least) [best, least] = [found, apart];
    };
    for (const one of this.clicks) take([one.x, one.y], { what: one.what, name: one.name, number: one.number });
    if (best) return best;
    for (const [name, place] of Object.entries(this.model.points)) if (place[0] !== null) take(place, { what: "point", name });
    if (best) return best;
    least = NEAR_LINE;
    for (const [name, line] of Object.entries(this.model.lines)) {
      for (let i = 1; i < line.length; i++) {
        if (line[i][0] === null || line[i - 1][0] === null) continue;
        const [a, b] = this.screen(line[i - 1]), [c, d] = this.screen(line[i]);
        const share = Math.min(Math.max(((x - a) * (c - a) + (y - b) * (d - b)) / ((c - a) ** 2 + (d - b) ** 2 || 1), 0), 1);
        const apart = Math.hypot(a + share * (c - a) - x, b + share * (d - b) - y);
        if (apart < least) [best, least] = [{ what: "place", name, number: null }, apart];
      }
    }
    return best;
  }

  // ---- the pointer ----

  down(event) {
    if (event.button > 1) return;
    this.canvas.setPointerCapture(event.pointerId);
    const at = this.at(event), pixel = this.pixel(...at);
    const handle = this.tool || event.button === 1 ? null : this.handle(at);
    const again = handle?.what === "point" && handle.name === this.selected; // a click on what was chosen says that it is right
    this.hold = { at, pixel, last: at, handle, again, moved: false };
    if (handle && handle.what === "point") this.act.select(handle.name);
  }
  move(event) {
    this.pointer = this.at(event);
    const hold = this.hold;
    if (!hold) {
      this.hovered = this.tool ? null : this.handle(this.pointer);
      this.canvas.classList.toggle("on-handle", Boolean(this.hovered));
      return this.draw();
    }
    hold.moved ||= Math.hypot(this.pointer[0] - hold.at[0], this.pointer[1] - hold.at[1]) > 3;
    if (hold.handle && hold.moved) this.act.drag(hold.handle, this.pixel(...this.pointer), false);
    else if (!hold.handle && this.tool !== "mask") this.pan(this.pointer[0] - hold.last[0], this.pointer[1] - hold.last[1]);
    hold.last = this.pointer;
    this.draw();
  }
  up(event) {
    const hold = this.hold, pixel = this.pixel(...this.at(event));
    this.hold = null;
    if (!hold) return;
    if (hold.handle && hold.moved) this.act.drag(hold.handle, pixel, true);
    else if (this.tool === "mask" && hold.moved) this.act.region([...hold.pixel, ...pixel]);
    else if (!hold.moved && (!hold.handle || hold.again)) this.act.click(pixel);
    this.draw();
  }

  // ---- drawing ----

  draw() {
    this.asked ||= requestAnimationFrame(() => { this.asked = 0; this.paint(); });
  }
  paint() {
    const { canvas, context, stage } = this, more = devicePixelRatio || 1;
    const width = Math.round(stage.clientWidth * more), height = Math.round(stage.clientHeight * more);
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    context.setTransform(more, 0, 0, more, 0, 0);
    context.clearRect(0, 0, width, height);
    this.colours = getComputedStyle(document.documentElement);
    if (this.picture) {
      context.imageSmoothingEnabled = this.scale < 3;
      context.drawImage(this.picture, this.left, this.top, this.size[0] * this.scale, this.size[1] * this.scale);
    }
    this.overlay(context, place => this.screen(place));
    this.magnify(more);
    this.act.painted();
  }
  colour(name) { return this.colours.getPropertyValue(`--${name}`).trim(); }

  overlay(context, to) {
    for (const region of this.regions) this.box(context, to(region.slice(0, 2)), to(region.slice(2)));
    if (this.hold && this.tool === "mask" && this.pointer) this.box(context, this.hold.at, this.pointer);
    for (const layer of this.layers) for (const line of layer.lines) this.line(context, line, to, this.colour(layer.colour), 1.5);
    const held = this.hold?.handle ?? this.hovered;
    for (const [name, line] of Object.entries(this.model.lines)) {
      const on = held?.what === "place" && held.name === name;
      this.line(context, line, to, this.colour("model"), on ? 3 : 1.6, this.unpainted?.has(name));
    }
    for (const stroke of this.strokes) this.stroke(context, stroke, to);
    for (const [name, place] of Object.entries(this.model.points)) {
      if (place[0] === null) continue;
      const [x, y] = to(place), on = this.selected === name || (held?.what === "point" && held.name === name);
      this.ring(context, x, y, on ? 7 : 4, this.colour("model"), on ? 2.5 : 1.5);
    }
    this.clicks.forEach((one, number) => this.click(context, one, this.model.feet[number], to));
    for (const shape of this.shapes) this.shape(context, shape, to);
    if (held && this.pointer && !this.hold && !this.clicks.some(one => one.against && one.name === held.name)) this.label(context, held.name, this.pointer[0] + 14, this.pointer[1] - 12);
  }

  line(context, line, to, colour, width, dashed = false) {
    context.beginPath();
    let on = false;
    for (const place of line) {
      if (place[0] === null) { on = false; continue; }
      const [x, y] = to(place);
      on ? context.lineTo(x, y) : context.moveTo(x, y);
      on = true;
    }
    context.setLineDash(dashed ? [3, 6] : []);
    context.lineJoin = "round";
    context.strokeStyle = "#0008"; context.lineWidth = width + 1.6; context.stroke();
    context.strokeStyle = colour; context.lineWidth = width; context.stroke();
    context.setLineDash([]);
  }
  ring(context, x, y, radius, colour, width, fill = null) {
    context.beginPath();
    context.arc(x, y, radius, 0, 7);
    if (fill) { context.fillStyle = fill; context.fill(); }
    context.strokeStyle = "#000a"; context.lineWidth = width + 1.6; context.stroke();
    context.strokeStyle = colour; context.lineWidth = width; context.stroke();
  }
  click(context, one, foot, to) {
    const [x, y] = to([one.x, one.y]), colour = this.colour(one.against ? "against" : "shown");
    if (foot && foot[0] !== null) {
      const [a, b] = to(foot);
      context.beginPath(); context.moveTo(x, y); context.lineTo(a, b);
      context.strokeStyle = colour; context.lineWidth = 2; context.stroke();
    }
    if (one.what === "point") this.ring(context, x, y, 5, "#fff", 1.6, colour);
    else {
      context.beginPath();
      context.moveTo(x, y - 6); context.lineTo(x + 6, y); context.lineTo(x, y + 6); context.lineTo(x - 6, y); context.closePath();
      context.fillStyle = colour; context.fill();
      context.strokeStyle = "#fff"; context.lineWidth = 1.6; context.stroke();
    }
    if (one.against) this.label(context, `${one.name}: ${one.off.toFixed(0)} px from where the others predict it`, x + 12, y - 12, colour);
  }
  stroke(context, [x, y, across, down, out], to) {
    const [a, b] = to([x, y]), [c, d] = to([x + this.enlarged * across, y + this.enlarged * down]);
    context.strokeStyle = this.colour(out ? "against" : "before");
    context.lineWidth = 1.6;
    context.beginPath(); context.moveTo(a, b);
    if (out) { context.moveTo(a - 4, b - 4); context.lineTo(a + 4, b + 4); context.moveTo(a - 4, b + 4); context.lineTo(a + 4, b - 4); }
    else context.lineTo(c, d);
    context.stroke();
  }
  shape(context, shape, to) {
    this.line(context, shape.pixels, to, this.colour("shown"), 3);
    const seen = shape.pixels.filter(place => place[0] !== null);
    if (!seen.length) return;
    const [x, y] = to(seen[seen.length - 1]);
    if (seen.length === 1) this.ring(context, x, y, 10, this.colour("shown"), 3);
    this.label(context, shape.label, x + 14, y - 14, this.colour("shown"));
  }
  box(context, [a, b], [c, d]) {
    context.fillStyle = "#000a";
    context.fillRect(Math.min(a, c), Math.min(b, d), Math.abs(c - a), Math.abs(d - b));
    context.strokeStyle = "#fff"; context.lineWidth = 1; context.setLineDash([4, 4]);
    context.strokeRect(Math.min(a, c), Math.min(b, d), Math.abs(c - a), Math.abs(d - b));
    context.setLineDash([]);
  }
  label(context, text, x, y, colour = "#fff") {
    context.font = "600 12px system-ui, sans-serif";
    const width = context.measureText(text).width + 14;
    x = Math.max(4, Math.min(x, this.stage.clientWidth - width - 4));
    y = Math.max(22, y);
    context.fillStyle = "#14191ee0";
    context.beginPath(); context.roundRect(x, y - 17, width, 23, 6); context.fill();
    context.fillStyle = colour;
    context.fillText(text, x + 7, y - 1);
  }

  // What is beneath the pointer, or the corner that the keys move, enlarged, in the corner that is farther away.
  magnify(more) {
    const place = this.hold?.handle || this.hovered ? this.pointer && this.pixel(...this.pointer) : this.keyed;
    this.lens.classList.toggle("on", Boolean(place && this.picture));
    if (!place || !this.picture) return;
    this.lens.classList.toggle("left", this.screen(place)[0] > this.stage.clientWidth / 2);
    const size = 200 * more, scale = Math.max(this.scale * LENS, 4), half = 100;
    if (this.lens.width !== size) this.lens.width = this.lens.height = size;
    const context = this.lens.getContext("2d");
    context.setTransform(more, 0, 0, more, 0, 0);
    context.fillStyle = this.colour("stage"); context.fillRect(0, 0, 200, 200);
    const to = ([x, y]) => [(x - place[0]) * scale + half, (y - place[1]) * scale + half];
    const reach = half / scale, ratio = (this.picture.naturalWidth || this.size[0]) / this.size[0];
    context.imageSmoothingEnabled = scale < 6;
    context.drawImage(
      this.picture, (place[0] + 0.5 - reach) * ratio, (place[1] + 0.5 - reach) * ratio, 2 * reach * ratio, 2 * reach * ratio, 0, 0, 200, 200,
    );
    for (const line of Object.values(this.model.lines)) this.line(context, line, to, this.colour("model"), 1.5);
    context.strokeStyle = "#fff"; context.lineWidth = 1;
    context.beginPath();
    context.moveTo(half, half - 14); context.lineTo(half, half - 4); context.moveTo(half, half + 4); context.lineTo(half, half + 14);
    context.moveTo(half - 14, half); context.lineTo(half - 4, half); context.moveTo(half + 4, half); context.lineTo(half + 14, half);
    context.stroke();
  }
}
