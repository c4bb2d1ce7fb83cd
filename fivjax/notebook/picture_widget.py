"""A picture in a notebook that reports clicks. It needs anywidget; `explore` says how to get it if it is missing."""

from typing import final

import anywidget
import traitlets

SCRIPT = """
function render({ model, el }) {
  const image = document.createElement("img");
  image.className = "fivjax-" + model.get("name");
  image.style.maxWidth = "100%";
  if (model.get("answers_clicks")) image.style.cursor = "crosshair";
  const draw = () => {
    const old = image.src;
    image.src = URL.createObjectURL(new Blob([model.get("png")], { type: "image/png" }));
    if (old) URL.revokeObjectURL(old);
  };
  image.addEventListener("click", (event) => {
    if (!model.get("answers_clicks")) return;
    const box = image.getBoundingClientRect();
    model.set("clicked", [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height]);
    model.save_changes();
  });
  model.on("change:png", draw);
  draw();
  el.appendChild(image);
}
export default { render };
"""


@final
class Picture(anywidget.AnyWidget):
    """A PNG picture; `clicked` is the point of the last click, as shares of its width and height from the upper left corner."""

    _esm = SCRIPT
    name = traitlets.Unicode().tag(sync=True)
    png = traitlets.Bytes().tag(sync=True)
    answers_clicks = traitlets.Bool(False).tag(sync=True)
    clicked = traitlets.List().tag(sync=True)
