"""How the pages that the package makes look: the colours of the report and the viewer, and the report's frame."""

from __future__ import annotations

from string import Template

#: What can be touched, and bars of figures.
ACCENT = "#4269d0"
#: Of a chart's or a bar's parts, in this order; they are told apart by colour-blind people too.
SERIES = (ACCENT, "#efb118", "#ff725c", "#6cc5b0", "#3ca951", "#ff8ab7", "#a463f2", "#97bbf5", "#9c6b4e")
#: Something failed, or is worst.
WARNING = "#ff725c"
#: Cameras that the encoder looks at, and those that only judge.
TRAINING_VIEW, TEST_VIEW = "#6cc5b0", "#efb118"
#: Behind pictures: neither dark nor bright ones look wrong on it.
STAGE = "#18181b"


def rgb(colour: str) -> tuple[int, int, int]:
    """Red, green and blue of "#rrggbb", 0 to 255."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


#: Takes ``title`` and ``body``, which are HTML already, and the colours ``accent`` and ``stage``.
PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'; \
script-src 'unsafe-inline'">
<title>$title</title>
<style>
:root { color-scheme: light dark; --line: #8884; --soft: #8882; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1100px; margin: 0 auto; padding: 1rem; }
h1 { font-size: 1.2rem; overflow-wrap: anywhere; }
h2 { font-size: 1.15rem; margin: 2.2rem 0 .6rem; border-bottom: 1px solid var(--line); }
h3 { font-size: 1rem; margin: 1.4rem 0 .4rem; overflow-wrap: anywhere; }
.cards { display: flex; flex-wrap: wrap; gap: .8rem; }
.cards div { background: var(--soft); border-radius: .5rem; padding: .6rem 1rem; }
.cards b { display: block; font-size: 1.5rem; }
.bar { width: 100%; height: 2.2rem; border-radius: .3rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; margin: .6rem 0; }
th, td { text-align: left; padding: .15rem 1.2rem .15rem 0; border-bottom: 1px solid var(--line); vertical-align: top; }
td { font-variant-numeric: tabular-nums; }
td i { display: inline-block; width: .8em; height: .8em; border-radius: .2em; margin-right: .5em; }
td:has(.meter) { min-width: 12rem; }
.meter { display: inline-block; height: .6em; background: $accent; border-radius: .2em; }
.pair, .columns, .charts { display: grid; gap: 1rem;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 22rem), 1fr)); }
.columns, .charts { align-items: start; }
figure { margin: 0; }
figcaption { opacity: .75; }
img { display: block; max-width: 100%; height: auto; }
.slider { position: relative; --at: 50%; background: $stage; width: fit-content; max-width: 100%; }
.slider .after { position: absolute; inset: 0; clip-path: inset(0 0 0 var(--at)); }
.slider input { position: absolute; inset: 0; width: 100%; height: 100%; margin: 0; opacity: 0; cursor: ew-resize; }
.slider::after { content: ""; position: absolute; top: 0; bottom: 0; left: var(--at); width: 2px; background: #fff;
  box-shadow: 0 0 3px #000; pointer-events: none; }
.slider:focus-within { outline: 2px solid $accent; }
.charts svg { width: 100%; }
svg text { font-size: 11px; fill: currentColor; }
svg .title { font-size: 13px; font-weight: 600; }
svg .grid { stroke: var(--line); }
svg .line { fill: none; stroke-width: 2; }
/* A phone: less room between, nothing wider than the page but what scrolls by itself. */
@media (max-width: 40rem) {
  body { padding: .6rem; }
  .cards { display: grid; grid-template-columns: 1fr 1fr; gap: .5rem; }
  .cards div { padding: .5rem .7rem; min-width: 0; }
  .cards b { font-size: 1.15rem; overflow-wrap: anywhere; }
  th, td { padding-right: .7rem; }
  td:first-child { overflow-wrap: anywhere; }
  td:not(:first-child) { white-space: nowrap; }
  td:has(.meter) { min-width: 4rem; }
}
/* Paper: dark on white, bars in their colours, nothing cut in two, and a slider is two halves that say so. */
@page { margin: 15mm; }
@media print {
  :root { color-scheme: light; }
  body { max-width: none; padding: 0; font-size: 10pt; background: #fff; color: #000;
    -webkit-print-color-adjust: exact; print-color-adjust: exact; }
  h2, h3 { break-after: avoid; }
  figure, tr, svg, .cards { break-inside: avoid; }
  .wide { overflow: visible; }
  .pair { grid-template-columns: 1fr 1fr; }
  .slider input { display: none; }
}
</style>
</head>
<body>
$body
</body>
</html>
""")
