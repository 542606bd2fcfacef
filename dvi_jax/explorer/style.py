"""Colours and style sheets of the page, light and dark by the setting of the browser."""

PALETTE = (
    *("#2f7fd6", "#d97706", "#109b74", "#cf5a9b", "#8b6cf0", "#d1495b"),
    *("#3aa6c9", "#9a8f1d", "#7f8791", "#b0623a"),
)
"""Colours of orbits and lines, legible on white and on black."""

COLOURS = """
:host, :root {
  --paper: #ffffff; --page: #f4f5f7; --ink: #1d2430; --soft: #5a6474; --line: #d6dae1;
  --field: #ffffff; --accent: #2362b0; --accent-ink: #ffffff; --alarm: #fdeceb;
  --alarm-ink: #8f1d14; --track: #c9d4e4;
}
@media (prefers-color-scheme: dark) {
  :host, :root {
    --paper: #1a1e25; --page: #11141a; --ink: #e7eaf0; --soft: #a3adbb; --line: #3a424f;
    --field: #232932; --accent: #7db4f5; --accent-ink: #0d1522; --alarm: #3d1c1b;
    --alarm-ink: #ffb4ab; --track: #3d4757;
  }
}
:host {
  --bk-background-fill-color: var(--paper); --bk-border-fill-color: var(--paper);
  --bk-outline-line-color: var(--line); --bk-grid-line-color: var(--line);
  --bk-axis-line-color: var(--soft); --bk-major-tick-line-color: var(--soft);
  --bk-minor-tick-line-color: var(--line); --bk-major-label-text-color: var(--ink);
  --bk-axis-label-text-color: var(--ink); --bk-label-text-color: var(--ink);
  --bk-text-color: var(--ink); --bk-title-text-color: var(--ink);
}
"""
"""Custom properties; those of bokeh begin with --bk- and set the colours of its figures."""

PAGE = (
    COLOURS
    + """
body { margin: 0; background: var(--page); color: var(--ink); }
"""
)

REDRAW = """
matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => {
  for (const model of cb_obj.all_models) if (model.type === 'Figure') model.change.emit();
});
"""
"""Script of the document: a figure is a canvas, which has its colours until it is drawn again."""

ROOT = """
:host { background: var(--page); color: var(--ink); box-sizing: border-box; gap: 14px;
  padding: 14px 18px 28px; max-width: 1500px; margin: 0 auto;
  font: 15px/1.45 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
@media (max-width: 760px) { :host { padding: 10px; } }
"""

CARD = """
:host { background: var(--paper); border: 1px solid var(--line); border-radius: 10px;
  padding: 12px 14px; box-sizing: border-box; }
"""

SIDE = (
    CARD
    + ":host { flex: 1 1 270px; max-width: 340px; } "
    + ("@media (max-width: 760px) { :host { max-width: none; order: 2; flex-basis: 100%; } }")
)

MAIN = (
    CARD
    + ":host { flex: 4 1 560px; min-width: 0; } "
    + ("@media (max-width: 760px) { :host { flex-basis: 100%; padding: 8px 6px; } }")
)

TEXT = """
:host { color: var(--ink); font: 15px/1.45 system-ui, "Segoe UI", Roboto, sans-serif; margin: 0; }
h1 { font-size: 22px; margin: 0 0 2px; font-weight: 650; }
h2 { font-size: 13px; margin: 10px 0 2px; font-weight: 650; letter-spacing: .04em;
  text-transform: uppercase; color: var(--soft); }
p { margin: 2px 0; color: var(--soft); }
.alarm { background: var(--alarm); color: var(--alarm-ink); border-radius: 8px; padding: 8px 12px;
  overflow-wrap: anywhere; }
.note { color: var(--soft); font-size: 13px; }
table { border-collapse: collapse; width: 100%; font-size: 14px; }
td, th { text-align: left; padding: 5px 8px; border-bottom: 1px solid var(--line);
  vertical-align: top; overflow-wrap: anywhere; }
progress { width: 100%; accent-color: var(--accent); }
.names { margin: 0 0 0 52px; } .names span { margin: 0 4px 0 8px; }
.label { color: var(--ink); font-size: 13px; }
.scale { display: inline-block; width: 160px; height: 10px; border-radius: 5px; margin: 0 8px; }
.swatch { display: inline-block; width: 11px; height: 11px; border-radius: 50%; }
"""

WIDGET = """
:host { color: var(--ink); font: 14px/1.4 system-ui, "Segoe UI", Roboto, sans-serif; }
label { color: var(--ink); font-size: 13px; }
.bk-input { background-color: var(--field) !important; color: var(--ink) !important;
  border: 1px solid var(--line) !important; border-radius: 6px; font-size: 13px; }
.bk-input:focus { border-color: var(--accent) !important; outline: none; }
select.bk-input { background-image: linear-gradient(45deg, transparent 50%, var(--soft) 50%),
  linear-gradient(135deg, var(--soft) 50%, transparent 50%) !important;
  background-position: calc(100% - 15px) 55%, calc(100% - 10px) 55% !important;
  background-size: 5px 5px !important; background-repeat: no-repeat !important; }
.bk-spin-btn { background-color: transparent !important; }
.bk-spin-btn::before { border-bottom-color: var(--soft) !important;
  border-top-color: var(--soft) !important; }
.noUi-target { background: var(--track) !important; border: none !important;
  box-shadow: none !important; height: 5px !important; border-radius: 3px; }
.noUi-connect { background: var(--accent) !important; }
.noUi-handle { background: var(--accent) !important; border: 2px solid var(--paper) !important;
  box-shadow: none !important; border-radius: 50% !important; width: 17px !important;
  height: 17px !important; top: -6px !important; right: -8px !important; cursor: pointer; }
.noUi-handle::before, .noUi-handle::after { display: none !important; }
a { color: inherit !important; padding: 0 !important; text-decoration: none !important; }
.bk-btn { background: var(--field) !important; color: var(--ink) !important;
  font-size: 13px !important; border: 1px solid var(--line) !important;
  border-radius: 7px !important; padding: 6px 11px !important; }
.bk-btn:hover { border-color: var(--accent) !important; color: var(--accent) !important; }
.bk-btn-primary { background: var(--accent) !important; color: var(--accent-ink) !important; }
.bk-btn-primary:hover { color: var(--accent-ink) !important; opacity: .9; }
.bk-btn:disabled { opacity: .5; }
.bk-btn:focus-visible, .noUi-handle:focus-visible { outline: 2px solid var(--accent);
  outline-offset: 2px; }
textarea.bk-input { font: 12px/1.45 ui-monospace, "DejaVu Sans Mono", monospace; }
"""

TABS = """
:host { border-bottom: 1px solid var(--line); }
.bk-btn-group { flex-wrap: wrap; gap: 0 !important; }
.bk-btn { background: none !important; border: none !important; color: var(--soft) !important;
  border-bottom: 2px solid transparent !important; border-radius: 0 !important;
  box-shadow: none !important; padding: 7px 12px !important;
  font: 600 14px system-ui, "Segoe UI", Roboto, sans-serif !important; }
.bk-btn.bk-active { color: var(--accent) !important;
  border-bottom-color: var(--accent) !important; }
.bk-btn:focus-visible { outline: 2px solid var(--accent); }
"""
