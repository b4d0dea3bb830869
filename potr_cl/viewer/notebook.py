"""A viewer within a notebook (:func:`notebook_bundle`): its page, or a still where no page can be shown.

A notebook is also read where no viewer runs: converted to a page, on a site, after the program has ended. So the still
is what stands there, and the page takes its place only once it has said from within that it lives.
"""

from __future__ import annotations

import base64
import io
import secrets
from html import escape
from string import Template
from typing import Any

from PIL import Image

from potr_cl.report.labels import U8

_HTML = Template("""<div id="$id" style="position:relative;max-width:100%;width:${width}px">
<img src="data:image/jpeg;base64,$still" alt="$alt" style="display:block;width:100%">
<iframe src="$url" title="$alt" allow="fullscreen" style="display:none;border:0;width:100%;height:${height}px"></iframe>
<script>
(() => {
  const box = document.getElementById("$id"), frame = box.querySelector("iframe");
  addEventListener("message", event => {
    if (event.source !== frame.contentWindow || event.data !== "potr_cl viewer") return;
    box.querySelector("img").style.display = "none";
    frame.style.cssText = "display:block;border:0;width:100%;height:${height}px";
    box.style.width = "100%";
  });
})();
</script></div>""")


def notebook_bundle(said: str, url: str | None, picture: U8 | None, height: int = 600) -> dict[str, Any]:
    """What a notebook shows, by media type.

    Args:
        said: the viewer in words.
        url: of its page; None if there is none.
        picture: (H, W, 3) uint8, the still; None where no device renders one.
        height: of the page, in pixels of the browser.
    """
    bundle: dict[str, Any] = {"text/plain": said}
    if picture is None:
        return bundle
    file = io.BytesIO()
    Image.fromarray(picture).save(file, format="JPEG", quality=90)
    still = base64.b64encode(file.getvalue()).decode("ascii")
    bundle["image/jpeg"] = still
    if url is not None:
        bundle["text/html"] = _HTML.substitute(
            id=f"potr-{secrets.token_hex(6)}",
            still=still,
            alt=escape(said),
            url=escape(url),
            width=picture.shape[1],
            height=height,
        )
    return bundle
