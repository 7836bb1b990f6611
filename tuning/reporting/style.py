"""The style of a page: on white and on dark screens, on narrow ones, and on paper."""

from __future__ import annotations

DARK = """color-scheme: dark; --paper: #15191d; --ink: #e4e7ea; --soft: #aab3ba; --line: #3a424a; 
  --strong: #5a646e; --card: #1e2930; --mark: #5fb3dc; --link: #7cc4ea;"""
# A shadow at each edge behind which there is more: two covers scroll with what they cover, the shadows stay.
UNDER = "var(--under, var(--paper))"
SHADOWS = f"""linear-gradient(to right, {UNDER} 40%, transparent) left / 3rem 100% no-repeat local,
  linear-gradient(to left, {UNDER} 40%, transparent) right / 3rem 100% no-repeat local,
  linear-gradient(to right, var(--strong), transparent) left / .8rem 100% no-repeat scroll,
  linear-gradient(to left, var(--strong), transparent) right / .8rem 100% no-repeat scroll, {UNDER}"""
STYLE = f"""
:root {{ color-scheme: light; --paper: #fff; --ink: #222; --soft: #444; --line: #e0e0e0; --strong: #bbb;
  --card: #f1f6f9; --mark: #0b6fa4; --link: #0b5c88; }}
@media screen and (prefers-color-scheme: dark) {{ :root:not(.light) {{ {DARK} }} }}
@media screen {{ :root.dark {{ {DARK} }} }}
* {{ box-sizing: border-box; }}
html {{ scroll-behavior: smooth; }}
body {{ margin: 0 auto; max-width: 68rem; padding: 1.5rem 1rem 4rem; background: var(--paper); color: var(--ink);
  font: 1rem/1.55 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; overflow-wrap: break-word; }}
a {{ color: var(--link); }}
h1 {{ font-size: 1.6rem; line-height: 1.25; margin: 0 0 1rem; }}
h2 {{ font-size: 1.2rem; margin: 2.5rem 0 .5rem; padding-top: .75rem; border-top: 1px solid var(--line); }}
h3 {{ font-size: 1rem; margin: 1.5rem 0 .25rem; }}
p, ul {{ max-width: 46rem; }}
.advice {{ margin: 0 0 1rem; padding: .75rem 1rem; border-left: 4px solid var(--mark); background: var(--card);
  font-size: 1.1rem; max-width: none; }}
nav {{ font-size: .92rem; }}
nav ol {{ margin: .25rem 0 0; padding-left: 1.4rem; columns: 18rem; }}
nav a {{ text-decoration: none; }}
nav a:hover {{ text-decoration: underline; }}
.scroll {{ overflow-x: auto; margin: 1rem 0; }}
table {{ border-collapse: collapse; font-variant-numeric: tabular-nums; }}
.scroll, .picture, .code pre {{ background: {SHADOWS}; }}
.caption {{ font-weight: 600; margin: 1.25rem 0 0; }}
.caption + .scroll {{ margin-top: .35rem; }}
th, td {{ padding: .3rem 0 .3rem .9rem; text-align: right; vertical-align: top;
  border-bottom: 1px solid var(--line); }}
th:first-child {{ text-align: left; padding-left: 0; position: sticky; left: 0; background: var(--paper); }}
td {{ white-space: nowrap; }}
td small {{ display: block; color: var(--soft); }}
table.words td {{ text-align: left; white-space: normal; }}
thead th {{ border-bottom: 2px solid var(--strong); vertical-align: bottom; }}
figure {{ margin: 1rem 0; position: relative; }}
.picture {{ overflow-x: auto; position: relative; }}
svg {{ display: block; max-width: 100%; height: auto; fill: currentColor; touch-action: pan-y; }}
figcaption {{ color: var(--soft); font-size: .92rem; max-width: 46rem; }}
.read svg {{ cursor: crosshair; }}
.read .value {{ position: absolute; pointer-events: none; display: none; z-index: 2; padding: .25rem .5rem;
  background: var(--paper); border: 1px solid var(--strong); border-radius: .25rem; font-size: .8rem;
  font-variant-numeric: tabular-nums; white-space: pre; line-height: 1.35; }}
pre {{ background: var(--card); padding: .75rem 1rem; overflow-x: auto; font-size: .85rem; line-height: 1.45; }}
.code {{ position: relative; --under: var(--card); }}
.code button {{ position: absolute; top: .4rem; right: .4rem; font: inherit; font-size: .8rem; cursor: pointer;
  color: var(--ink); background: var(--paper); border: 1px solid var(--strong); border-radius: .25rem; }}
details {{ margin: .5rem 0; }}
summary {{ cursor: pointer; font-weight: 600; }}
.pair {{ display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 30rem), 1fr)); gap: 0 2rem; }}
.pair > * {{ min-width: 0; }}
.pair.deep {{ display: block; }}
.whose {{ font-weight: 600; color: var(--mark); margin: .75rem 0 0; }}
body.two-columns {{ max-width: 84rem; }}
@media screen and (max-width: 40rem) {{
  body {{ padding: 1rem .75rem 3rem; }}
  h1 {{ font-size: 1.35rem; }}
  th, td {{ padding-left: .7rem; }}
  th:first-child {{ max-width: 6.5rem; }}
  table.fold, table.fold tbody, table.fold tr, table.fold th, table.fold td {{ display: block; }}
  table.fold thead {{ display: none; }}
  table.fold tr {{ padding: .4rem 0; border-bottom: 1px solid var(--strong); }}
  table.fold th:first-child {{ max-width: none; }}
  table.fold th, table.fold td {{ border: 0; padding: .1rem 0; }}
  table.fold td {{ display: flex; flex-wrap: wrap; justify-content: flex-end; gap: 0 .5rem; white-space: normal; }}
  table.fold td::before {{ content: attr(data-head); margin-right: auto; color: var(--soft); }}
  table.fold td small {{ flex-basis: 100%; }}
  table.fold td:empty {{ display: none; }}
  .wide svg {{ max-width: none; width: 38rem; }}
  .wide figcaption::before {{ content: "Scroll the picture sideways. "; font-weight: 600; }}
}}
@media print {{
  @page {{ size: A4; margin: 14mm 12mm; }}
  body, body.two-columns {{ max-width: none; padding: 0; font-size: 9.5pt; }}
  nav, .code button, .read .value {{ display: none !important; }}
  h2 {{ margin-top: 1.2rem; break-after: avoid; }}
  h3, .caption {{ break-after: avoid; }}
  .scroll, .picture, pre {{ overflow: visible; }}
  .scroll, .picture {{ background: none; }}
  .code pre {{ background: var(--card); }}
  details > :not(summary) {{ display: block !important; }}
  details::details-content {{ display: block !important; content-visibility: visible !important; }}
  table {{ font-size: 8pt; width: 100%; }}
  table.words {{ width: auto; }}
  table.many {{ font-size: 6.5pt; }}
  th, td {{ padding-left: .45rem; white-space: normal; overflow-wrap: anywhere; }}
  td small {{ white-space: nowrap; font-size: 85%; }}
  th:first-child {{ position: static; }}
  th {{ hyphens: auto; overflow-wrap: normal; }}
  pre {{ white-space: pre-wrap; font-size: 7.5pt; }}
  figure, tr, .pair > * {{ break-inside: avoid; }}
  svg {{ max-height: 235mm; }}
  .pair {{ display: block; }}
  .pair.close {{ display: grid; grid-template-columns: 1fr 1fr; gap: 0 6mm; }}
}}
"""
