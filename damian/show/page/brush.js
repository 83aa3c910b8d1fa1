/** The part of the time that rows and charts show: two handles below the slider, and what a drag chooses. */

import { plain } from "page/marks";

/** Way of the pointer from which on a press is a drag [px]. */
const DRAG = 4;

/**
 * A press goes to a time, a drag chooses a part of the time.
 * @param {HTMLElement} element
 * @param {function(PointerEvent): number} timeAt
 * @param {import("page/player").Player} player
 * @param {boolean} moves whether a drag within the part that is shown moves it
 */
export function listenToDrag(element, timeAt, player, moves = false) {
  let begin = null;
  const isDrag = (event) => begin !== null && Math.abs(event.clientX - begin.x) >= DRAG;
  element.addEventListener("pointerdown", (event) => {
    if (event.target !== element || event.button) return;
    const [time, [from, to]] = [timeAt(event), player.shown];
    begin = {
      x: event.clientX,
      time,
      shown: moves && player.isZoomed && time > from && time < to && [from, to],
    };
    element.setPointerCapture(event.pointerId);
  });
  element.addEventListener("pointermove", (event) => {
    if (!isDrag(event)) return;
    const time = timeAt(event);
    if (begin.shown) player.show(...begin.shown.map((end) => end + time - begin.time));
    else player.choose(begin.time, time);
  });
  element.addEventListener("pointerup", (event) => {
    if (isDrag(event)) {
      if (!begin.shown) player.show(begin.time, timeAt(event));
    } else if (begin) player.seek(begin.time);
    begin = null;
    player.choose(null);
  });
  element.addEventListener("pointercancel", () => {
    begin = null;
    player.choose(null);
  });
  element.addEventListener("dblclick", () => player.showAll());
}

/** The handles, and a button that shows all of the time again. */
export function addBrush(parent, player) {
  const brush = document.createElement("div");
  brush.className = "brush";
  brush.title = "the part of the time that rows and charts show (T, Shift T, A)";
  const handles = ["first", "last"].map((which) => {
    const handle = document.createElement("input");
    Object.assign(handle, { type: "range", min: 0, max: player.span, step: "any" });
    handle.setAttribute("aria-label", `${which} time that rows and charts show`);
    handle.addEventListener("input", () => player.show(...handles.map((each) => Number(each.value))));
    brush.append(handle);
    return handle;
  });
  listenToDrag(
    brush,
    (event) => {
      const { left, width } = brush.getBoundingClientRect();
      return ((event.clientX - left) / width) * player.span;
    },
    player,
    true,
  );
  const all = document.createElement("button");
  Object.assign(all, { type: "button", textContent: "all", title: "show all of the time (A)" });
  all.setAttribute("aria-label", "show all of the time");
  all.addEventListener("click", () => player.showAll());
  parent.append(brush, all);
  player.onChange(() => {
    handles.forEach((handle, i) => {
      handle.value = player.shown[i];
      handle.setAttribute("aria-valuetext", `${plain(player.shown[i])} s`);
    });
    const [from, to] = player.chosen ?? player.shown;
    brush.style.setProperty("--from", from / player.span);
    brush.style.setProperty("--to", to / player.span);
    all.disabled = !player.isZoomed;
  });
}
