/** Canvases as sharp as the screen. */

/** The empty context of a canvas that fills its element, in pixels of the page. */
export function fitted(canvas, width, height) {
  const [columns, rows] = [Math.round(width * devicePixelRatio), Math.round(height * devicePixelRatio)];
  if (canvas.width !== columns || canvas.height !== rows)
    Object.assign(canvas, { width: columns, height: rows });
  const context = canvas.getContext("2d");
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.clearRect(0, 0, columns, rows);
  context.scale(devicePixelRatio, devicePixelRatio);
  return context;
}
