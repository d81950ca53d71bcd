// The steps beside the picture.

const $ = id => document.getElementById(id);

function element(name, properties = {}, ...children) {
  const { data, ...rest } = properties, one = Object.assign(document.createElement(name), rest);
  one.append(...children.filter(child => child !== null));
  return one;
}

export class Panel {
  constructor(act) {
    this.act = act;
    this.height = 0;
    $("target").onchange = event => act.change({ target: event.target.value, points: {}, places: [], not_painted: [], lengths: {}, solved: [], facing: "" });
    $("choose").onchange = event => { act.select(event.target.value); event.target.value = ""; };
    $("board-size").onchange = event => act.change({ board: event.target.value.trim() });
    const prior = () => {
      const height = parseFloat($("height").value), sd = parseFloat($("height-sd").value);
      const others = this.now.state.priors.filter(one => !one.includes("height_m"));
      act.change({ priors: height > 0 && sd > 0 ? [...others, `height_m=${height}:${sd}mm`] : others });
    };
    $("height").onchange = prior;
    $("height-sd").onchange = prior;
  }

  show(now, selected, photograph) {
    this.now = now;
    const busy = Boolean(now.busy), shown = Object.keys(now.state.points).length;
    this.targets(now);
    this.dimensions(now);
    this.painted(now);
    this.exports(now);
    this.clicks(now, selected);
    this.known(now);
    this.written(now);
    this.looking(now);
    if (document.activeElement !== $("board-size")) $("board-size").value = now.state.board;
    if (now.state.board) $("board").open = true;
    const prior = now.state.priors.find(one => one.includes("height_m"))?.match(/=([\d.]+):([\d.]+)/);
    if (prior && document.activeElement !== $("height")) [$("height").value, $("height-sd").value] = [prior[1], prior[2]];
    const left = now.state.regions.filter(one => one.photograph === now.photographs[photograph].name);
    $("masked").replaceChildren(...(left.length ? [`${left.length} left out `, element("button", {
      className: "take", textContent: "✕", title: "Nothing is left out of this photograph",
      onclick: () => this.act.change({ regions: now.state.regions.filter(one => !left.includes(one)) }),
    })] : []));
    $("goal").hidden = !now.goal;
    $("goal").textContent = now.state.facing ? now.state.facing.replace("=", ": ") : `Where is ${now.goal}?`;
    $("progress").textContent = !now.target ? "" : shown ? "" : "Or drag four corners of the model to where they are.";
    $("auto").disabled = busy || (!now.target && !now.state.board);
    $("find").disabled = busy || !(now.target ? shown >= 4 || (now.looked.start && !shown && !now.state.places.length) : now.state.board);
    $("done").disabled = busy || !now.found;
    $("done").title = now.found ? `Writes ${now.folder}/` : "Find the lines first";
  }

  targets(now) {
    const names = now.targets.includes(now.state.target) || !now.state.target ? now.targets : [now.state.target, ...now.targets];
    const none = now.looked.start ? `as in ${now.looked.start.name}` : "none";
    $("target").replaceChildren(element("option", { value: "", textContent: none }), ...names.map(name => element("option", { value: name, textContent: name })));
    $("target").value = now.state.target;
  }
  dimensions(now) {
    const { lengths, solved } = now.state;
    $("dimensions").hidden = !now.target;
    if ($("dimensions").contains(document.activeElement)) return;
    $("dimensions").lastElementChild.replaceChildren(...Object.entries(now.target?.dimensions ?? {}).map(([name, value]) => {
      const length = element("input", { type: "number", value: +value.toFixed(4), min: 0.001, step: "any", title: "m" });
      length.onchange = () => length.value > 0 && this.act.change({ lengths: { ...lengths, [name]: +length.value } });
      const free = element("input", { type: "checkbox", checked: solved.includes(name), title: "Solve for it" });
      free.onchange = () => this.act.change({ solved: free.checked ? [...solved, name] : solved.filter(one => one !== name) });
      const words = name.replace(/_m$/, "").replaceAll("_", " ");
      length.ariaLabel = `${words}, m`;
      return element("label", {}, element("span", { textContent: words }), element("span", {}, length, " m ", free, " solve"));
    }));
  }
  painted(now) {
    const without = now.state.not_painted;
    $("painted").hidden = !now.target;
    $("painted").lastElementChild.replaceChildren(...(now.target?.curves ?? []).map(name => {
      const box = element("input", { type: "checkbox", checked: without.includes(name) });
      box.onchange = () => this.act.change({ not_painted: box.checked ? [...without, name] : without.filter(one => one !== name) });
      return element("label", { className: "check" }, box, name);
    }));
  }
  exports(now) {
    const chosen = now.state.exports;
    $("exports").lastElementChild.replaceChildren(...now.formats.map(name => {
      const box = element("input", { type: "checkbox", checked: chosen.includes(name) });
      box.onchange = () => this.act.change({ exports: box.checked ? [...chosen, name] : chosen.filter(one => one !== name) });
      return element("label", { className: "check" }, box, name);
    }));
  }
  clicks(now, selected) {
    const row = (name, label, off, take, on) => {
      const against = off !== undefined;
      return element("li", { className: `${on ? "on" : ""} ${against ? "against" : ""}` },
        element("button", { textContent: label, title: name, onclick: () => this.act.select(name) }),
        element("span", { className: "off", textContent: against ? `${off.toFixed(0)} px off` : "" }),
        element("button", { className: "take", textContent: "✕", title: "Take it back", ariaLabel: `Take back ${label}`, onclick: take }));
    };
    const points = Object.keys(now.state.points).map(name => row(name, name, now.against[name], () => {
      const { [name]: _, ...rest } = now.state.points;
      this.act.change({ points: rest });
    }, name === selected));
    const places = now.state.places.map((one, number) => row(one.curve, `◆ ${one.curve}`, now.against[`#${number}`],
      () => this.act.change({ places: now.state.places.filter((_, other) => other !== number) }), false));
    $("clicks").replaceChildren(...points, ...places);
    const left = (now.target?.points ?? []).filter(name => !(name in now.state.points));
    $("choose").parentElement.hidden = !left.length;
    if (document.activeElement !== $("choose")) {
      $("choose").replaceChildren(element("option", { value: "", textContent: "a corner …" }), ...left.map(name => element("option", { value: name, textContent: name })));
    }
  }

  known(now) {
    const known = now.known;
    if (!known) return $("known").replaceChildren(element("p", { className: "quiet", textContent: "Nothing yet: find the field first." }));
    const numbers = element("dl", { className: "numbers" });
    for (const one of known.numbers) {
      numbers.append(element("dt", { textContent: one.name }), element("dd", { textContent: `${one.value.replace(/ \S+$/, "")} ${one.sd}` }),
        element("dd", { className: one.verdict.split(" ").pop(), textContent: one.verdict }));
    }
    const parts = [element("p", { className: `verdict ${known.level}`, textContent: known.headline }), numbers];
    if (!now.found) parts.unshift(element("p", { className: "quiet", textContent: "By what was dragged alone; find the lines to know more:" }));
    if (known.maps.length) parts.push(...this.map(now, known));
    for (const [number, one] of (known.advice ?? []).entries()) {
      const button = element("button", { className: "advice", title: "Show where in the picture" }, number ? "Then " : "Next: ", one.words,
        element("small", { textContent: [...(one.steps.length <= 3 ? one.steps : []), one.leaves].join("; ") }));
      button.onclick = () => this.act.advise(one.shapes);
      parts.push(button);
    }
    const reasons = element("details", {}, element("summary", { textContent: "Why" }), element("div", {},
      ...known.reasons.map(one => element("p", { className: "quiet", textContent: one.text }))));
    reasons.open = this.reasonsOpen;
    reasons.ontoggle = () => (this.reasonsOpen = reasons.open);
    $("known").replaceChildren(...parts, reasons);
  }
  map(now, known) {
    const canvas = element("canvas", { id: "map", role: "img" }), shown = known.maps[Math.min(this.height, known.maps.length - 1)];
    const heights = element("span", { className: "heights" }, ...known.maps.map((one, number) => {
      const button = element("button", { textContent: one.height_mm ? `${one.height_mm} mm` : "floor" });
      button.setAttribute("aria-pressed", number === this.height);
      button.onclick = () => { this.height = number; this.known(this.now); };
      return button;
    }));
    const colour = value => value === null ? null : value < 0 ? "#fcede4" : now.scale.colors[now.scale.borders.filter(one => value > one).length];
    drawMap(canvas, shown, known.paint, colour);
    canvas.ariaLabel = `95 % of located points are within so many mm, ${shown.height_mm} mm above the floor`;
    canvas.onpointermove = event => {
      const value = valueAt(canvas, shown, event);
      canvas.title = value === undefined ? "" : value === null ? "not seen" : value < 0 ? "unknown" : `95 % within ${value.toPrecision(2)} mm`;
    };
    const scale = element("div", { className: "scale", ariaHidden: "true" }, ...now.scale.colors.map((one, number) => {
      const step = element("span", { textContent: now.scale.borders[number] ?? "" });
      step.style.borderTopColor = one;
      return step;
    }));
    return [element("div", { className: "row" }, element("span", { textContent: "95 % within, mm" }), heights), canvas, scale];
  }

  written(now) {
    if (!now.written.length) return $("written").replaceChildren(element("p", { className: "quiet", textContent: `Results go to ${now.folder}/` }));
    const commands = now.written.join("\n"), copy = element("button", { textContent: "Copy" });
    copy.onclick = () => navigator.clipboard.writeText(commands).then(() => (copy.textContent = "Copied"));
    $("written").replaceChildren(
      element("p", { className: "row" }, element("span", { textContent: `Written to ${now.folder}/. Without a page:` }), copy),
      element("pre", { textContent: commands }));
  }
  looking(now) {
    const { start, other } = now.looked;
    $("looking").hidden = !start;
    if (!start) return;
    const key = element("p", { className: "keyed" }, element("span", {}, element("b", { className: "model" }), start.name));
    if (other) key.append(element("span", {}, element("b", { className: "before" }), other.name));
    $("looking").replaceChildren(element("h2", { textContent: other ? "Two calibrations" : "An old calibration" }), key,
      ...now.said.map(text => element("p", { className: "quiet", textContent: text })),
      element("button", { id: "check", textContent: other ? "Compare them by this photograph" : "Has the camera moved?", disabled: Boolean(now.busy) }));
  }
}

// ---- the map over the field ----

function drawMap(canvas, map, paint, colour) {
  const [x0, x1, y0, y1] = map.ends, width = 660, height = Math.round(width * (y1 - y0) / (x1 - x0));
  [canvas.width, canvas.height] = [width, height];
  const context = canvas.getContext("2d"), rows = map.rows.length, columns = map.rows[0].length;
  map.rows.forEach((row, r) => row.forEach((value, c) => {
    const fill = colour(value);
    if (!fill) return;
    context.fillStyle = fill;
    context.fillRect(c * width / columns - 0.5, (rows - 1 - r) * height / rows - 0.5, width / columns + 1, height / rows + 1);
  }));
  context.strokeStyle = "#3a4650";
  context.lineWidth = 1.6;
  for (const line of paint) {
    context.beginPath();
    for (const [x, y] of line) context.lineTo((x - x0) / (x1 - x0) * width, (y1 - y) / (y1 - y0) * height);
    context.stroke();
  }
}
function valueAt(canvas, map, event) {
  const box = canvas.getBoundingClientRect(), rows = map.rows.length, columns = map.rows[0].length;
  const c = Math.floor((event.clientX - box.left) / box.width * columns), r = rows - 1 - Math.floor((event.clientY - box.top) / box.height * rows);
  return map.rows[r]?.[c];
}
