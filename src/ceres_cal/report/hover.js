"use strict";
// The number of the place under the pointer: a picture says where its axes are (data-axes), its figure what is there.
(() => {
  const tip = document.body.appendChild(document.createElement("output"));
  tip.id = "tip";
  tip.hidden = true;
  const nearest = (value, [first, last, count]) => {
    const at = count > 1 ? Math.round((value - first) / (last - first) * (count - 1)) : 0;
    return at < 0 || at >= count ? null : at;
  };
  const place = (at, [first, last, count]) => String(+(first + (last - first) * at / (count - 1)).toPrecision(3));
  const said = (svg, event) => {
    const hover = JSON.parse(svg.closest("[data-hover]").dataset.hover), box = svg.getBoundingClientRect();
    const [left, top, right, bottom, x0, y0, x1, y1] = svg.dataset.axes.split(" ").map(Number);
    const across = ((event.clientX - box.left) / box.width - left) / (right - left);
    const down = ((event.clientY - box.top) / box.height - top) / (bottom - top);
    if (!(across >= 0 && across <= 1 && down >= 0 && down <= 1)) return "";
    const column = nearest(x0 + across * (x1 - x0), hover.x), row = nearest(y0 + down * (y1 - y0), hover.y);
    const value = column === null || row === null ? "" : hover.values[row * hover.x[2] + column];
    const words = {x: hover.names[0][column] ?? place(column, hover.x), y: hover.names[1][row] ?? place(row, hover.y), value};
    return value && hover.text.replace(/\{(\w+)\}/g, (_, name) => words[name]);
  };
  const show = event => {
    const svg = event.target.closest?.("[data-hover] svg"), text = svg ? said(svg, event) : "";
    tip.hidden = !text;
    tip.textContent = text;
    const room = document.documentElement.clientWidth - tip.offsetWidth - 8;
    tip.style.left = `${Math.max(Math.min(event.clientX + 14, room), 8)}px`;
    tip.style.top = `${event.clientY > 60 ? event.clientY - 40 : event.clientY + 20}px`;
  };
  for (const name of ["pointermove", "pointerdown"]) document.addEventListener(name, show);
  document.addEventListener("scroll", () => { tip.hidden = true; });
})();
