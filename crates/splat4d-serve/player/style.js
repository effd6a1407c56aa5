// Style: calm surfaces over the image, one accent colour. Sizes are in em of one font size that grows with the
// player, so that it is legible from 360 px to 4K. No blur: it would be paid for on every frame without a GPU.

const DARK = `--page:#0d0f12;--surface:rgba(20,23,28,.96);--raised:rgba(255,255,255,.07);--press:rgba(255,255,255,.13);
--line:rgba(255,255,255,.11);--text:#eef1f4;--muted:#a4adb8;--accent:#58d0be;--on-accent:#05211c;--bad:#ff9f8f;
--shadow:0 1px 2px rgba(0,0,0,.35),0 10px 32px rgba(0,0,0,.32);color-scheme:dark`;
const LIGHT = `--page:#eef0f2;--surface:rgba(255,255,255,.985);--raised:rgba(12,24,36,.06);--press:rgba(12,24,36,.12);
--line:rgba(12,24,36,.14);--text:#14191f;--muted:#56606b;--accent:#0a776b;--on-accent:#fff;--bad:#b3301c;
--shadow:0 1px 2px rgba(15,25,35,.1),0 10px 32px rgba(15,25,35,.14);color-scheme:light`;

export const CSS = `
:host{display:block;position:relative;width:100%;aspect-ratio:16/9;min-height:180px;overflow:hidden;contain:content}
:host([hidden]){display:none}
.root{${DARK};position:absolute;inset:0;overflow:clip;container-type:size;background:var(--page);color:var(--text);
 font-family:system-ui,-apple-system,"Segoe UI",Roboto,"DejaVu Sans",sans-serif;line-height:1.4;
 -webkit-tap-highlight-color:transparent}
@media (prefers-color-scheme:light){.root:not([data-theme=dark]){${LIGHT}}}
.root[data-theme=light]{${LIGHT}}
*,*::before,*::after{box-sizing:border-box}
.ui{font-size:clamp(14px,.27cqw + 10.8px,24px)}
.stage{position:absolute;inset:0;touch-action:none;cursor:grab;outline:none;user-select:none;-webkit-user-select:none}
.stage:active{cursor:grabbing}
.stage:focus-visible::after{content:"";position:absolute;inset:3px;border-radius:8px;pointer-events:none;
 border:2px solid var(--accent)}
canvas{display:block}
.stage>canvas{position:absolute;inset:0;width:100%;height:100%}
.poster{position:absolute;inset:0;width:100%;height:100%;object-fit:cover;pointer-events:none;opacity:0;
 transition:opacity .35s}
.poster.on{opacity:1}
button,select,input{font:inherit;color:inherit}
button{border:0;background:none;border-radius:.6em;cursor:pointer;padding:.45em .7em;display:inline-flex;
 align-items:center;justify-content:center;gap:.5em;white-space:nowrap;transition:background .12s}
button:hover{background:var(--raised)}
button:active{background:var(--press)}
button[disabled]{opacity:.4;cursor:default;background:none}
button.soft[disabled]{background:var(--raised)}
:is(button,select,input,.scrub,a):focus-visible{outline:2px solid var(--accent);outline-offset:2px}
.tool{width:2.6em;height:2.6em;padding:0;flex:none}
.tool[aria-pressed=true],.tool[aria-expanded=true]{color:var(--accent)}
.tool[aria-expanded=true]{background:var(--raised)}
.soft{background:var(--raised)}
.soft:hover{background:var(--press)}
.main{background:var(--accent);color:var(--on-accent);font-weight:600;padding:.6em 1.1em}
.main:hover{background:var(--accent);filter:brightness(1.08)}
.icon{width:1.45em;height:1.45em;fill:none;stroke:currentColor;stroke-width:1.7;stroke-linecap:round;
 stroke-linejoin:round;flex:none}
.icon.filled{fill:currentColor;stroke:none}
.card{background:var(--surface);border:1px solid var(--line);border-radius:1em;box-shadow:var(--shadow)}
.dock{position:absolute;inset:0;padding:clamp(8px,1.2em,28px);
 padding-bottom:max(clamp(8px,1.2em,28px),env(safe-area-inset-bottom));
 display:flex;flex-direction:column;justify-content:flex-end;align-items:flex-end;gap:.7em;pointer-events:none;
 transition:opacity .25s}
.dock>*{pointer-events:auto}
.idle .dock{opacity:0}
.idle .dock>*{pointer-events:none}
.idle .stage{cursor:none}
.bar{width:100%;max-width:72em;align-self:center;padding:.25em .55em .4em;flex:none}
.row{display:flex;align-items:center;gap:.15em;min-width:0}
.space{flex:1}
.time{font-variant-numeric:tabular-nums;color:var(--muted);padding:0 .7em;white-space:nowrap}
.time b{color:var(--text);font-weight:600}
.scrub{position:relative;height:1.7em;margin:0 .5em;cursor:pointer;touch-action:none;border-radius:.4em}
.rail,.rail>*{position:absolute;height:.28em;border-radius:1em;top:50%;transform:translateY(-50%)}
.rail{left:0;right:0;background:var(--press)}
.rail>.there{background:var(--muted);opacity:.45}
.rail>.done{left:0;background:var(--accent)}
.rail>.future{right:0;border-radius:0;background:repeating-linear-gradient(90deg,var(--text) 0 .16em,transparent .16em .4em)}
.rail>.future[hidden]{display:none}
.knob{position:absolute;top:50%;width:.95em;height:.95em;margin:-.475em;border-radius:50%;background:var(--accent);
 box-shadow:0 0 0 .2em var(--surface);transition:transform .12s}
.scrub:hover .knob,.scrub:focus-visible .knob{transform:scale(1.2)}
.tip{position:absolute;bottom:100%;transform:translateX(-50%);padding:.1em .55em;border-radius:.5em;font-size:.86em;
 background:var(--surface);border:1px solid var(--line);font-variant-numeric:tabular-nums;pointer-events:none;opacity:0}
.scrub:hover .tip{opacity:1}
input[type=checkbox]{width:1.15em;height:1.15em;accent-color:var(--accent);margin:.3em}
select{border:0;background:transparent;border-radius:.6em;padding:.45em .3em .45em .6em;cursor:pointer;height:2.6em;
 max-width:100%}
select:hover{background:var(--raised)}
option{background:Canvas;color:CanvasText}
.field select,.field input[type=number]{background:var(--raised);height:2.3em;border-radius:.6em;border:0;
 padding:0 .6em}
.seg{display:inline-flex;background:var(--raised);border-radius:.7em;padding:.18em;border:0;margin:0;min-width:0}
.seg label{position:relative;cursor:pointer}
.seg input{position:absolute;inset:0;opacity:0;margin:0;cursor:pointer;width:100%;height:100%}
.seg span{display:block;padding:.3em .75em;border-radius:.55em;color:var(--muted);white-space:nowrap}
.seg label:hover span{color:var(--text)}
.seg input:checked+span{background:var(--surface);color:var(--text);box-shadow:0 0 0 1px var(--line)}
.seg input:focus-visible+span{outline:2px solid var(--accent);outline-offset:1px}
.panel{width:25em;max-width:100%;overflow:auto;overscroll-behavior:contain;padding:1.1em 1.2em 1.2em;
 max-height:calc(100cqh - 8em);display:flex;flex-direction:column;gap:.95em}
.panel[hidden],[hidden]{display:none!important}
.head{display:flex;align-items:center;justify-content:space-between;margin:-.3em -.5em -.4em 0}
h2{font-size:1em;margin:0;font-weight:650}
h3{font-size:.8em;margin:.2em 0 -.4em;font-weight:600;color:var(--muted);letter-spacing:.04em}
.field{display:flex;align-items:center;justify-content:space-between;gap:.8em;flex-wrap:wrap}
.note{color:var(--muted);font-size:.88em;margin:0}
.keys{list-style:none;margin:0;padding:0;display:flex;flex-direction:column;gap:.3em;max-height:11em;overflow:auto}
.keys li{display:flex;align-items:center;gap:.4em;background:var(--raised);border-radius:.6em;padding-left:.6em}
.keys input{width:4.6em;background:var(--raised);border:0;padding:.15em .1em .15em .5em;border-radius:.4em}
.keys .soft{background:none}
.keys span{flex:1;color:var(--muted);font-size:.88em;font-variant-numeric:tabular-nums}
.wrap{display:flex;flex-wrap:wrap;gap:.45em}
.top{position:absolute;left:clamp(8px,1.2em,28px);top:clamp(8px,1.2em,28px);right:clamp(8px,1.2em,28px);
 pointer-events:none}
.left{display:flex;flex-direction:column;gap:.7em;align-items:flex-start;min-width:0;max-width:100%}
.title{padding:.4em .9em;max-width:100%;overflow:hidden;text-overflow:ellipsis;white-space:nowrap;font-weight:600}
.idle .title{opacity:0}
.title{transition:opacity .25s}
.depth{padding:.35em .9em;display:flex;gap:.6em;align-items:center;font-size:.88em;font-variant-numeric:tabular-nums}
.depth i{width:7em;height:.7em;border-radius:.35em;background:linear-gradient(90deg,#fff,#000);border:1px solid var(--line)}
.stats{padding:.7em .95em;display:grid;grid-template-columns:auto auto;gap:.1em 1.1em;font-size:.88em;
 font-variant-numeric:tabular-nums;margin:0;flex:none}
.stats dt{color:var(--muted)}
.stats dd{margin:0;text-align:right}
.live{padding:.75em .95em;width:19em;max-width:100%;pointer-events:auto;display:flex;flex-direction:column;gap:.5em}
.live canvas{width:100%;height:5em;display:block}
.live .names{display:flex;justify-content:space-between}
.live .area{position:relative;margin:.15em 0;padding:0 3.2em}
.live .area small{position:absolute}
.live .high{top:0}.live .low{bottom:0}
.live .area .psnr{left:0}.live .area .loss{right:0}
.live small.psnr{color:var(--accent)}
.live .figures{display:grid;grid-template-columns:1fr 1fr;gap:.5em .8em;font-variant-numeric:tabular-nums;
 white-space:nowrap}
.live small{color:var(--muted);font-size:.85em}
.live .figures small{display:block}.live .wait{grid-column:1/-1;white-space:normal}
.live .acts{display:flex;gap:.45em;flex-wrap:wrap}
.frusta{position:absolute;inset:0;width:100%;height:100%;pointer-events:none}
.photo{position:absolute;inset:0 0 0 50%;margin:0;background:var(--page);display:grid;place-items:center}
.photo img{width:100%;height:100%;object-fit:contain;position:absolute;inset:0}
.photo figcaption{position:absolute;top:clamp(8px,1.2em,28px);right:clamp(8px,1.2em,28px);padding:.35em .9em;font-size:.9em;
 font-variant-numeric:tabular-nums;max-width:90%}
.compared .stage{right:50%}
@container (max-aspect-ratio:1/1){.compared .stage{right:0;bottom:50%}.photo{inset:50% 0 0}}
.dot{width:.6em;height:.6em;border-radius:50%;background:var(--accent);display:inline-block;margin-right:.55em}
.dot.off{background:var(--muted)}
@keyframes breathe{50%{opacity:.35}}
.dot.on{animation:breathe 2s infinite}
.centre{position:absolute;inset:0;display:grid;place-items:center;grid-template:minmax(0,1fr)/minmax(0,1fr);
 padding:1.2em;pointer-events:none}
.notice{pointer-events:auto;max-width:34em;padding:1.8em 2em;display:flex;flex-direction:column;gap:.8em;
 align-items:flex-start;max-height:100%;overflow:auto}
.notice h2{font-size:1.2em;display:flex;gap:.6em;align-items:center;overflow-wrap:anywhere}
.notice p{margin:0;overflow-wrap:anywhere}
.notice code{font:.9em ui-monospace,"DejaVu Sans Mono",monospace;color:var(--muted);overflow-wrap:anywhere}
.notice.bad h2 .icon{color:var(--bad)}
.notice.drop{border-style:dashed;border-width:2px;align-items:center;text-align:center;padding:2.6em 3em}
.over .notice.drop,.notice.drop.over{border-color:var(--accent)}
.help{width:44em;max-width:100%;max-height:100%;overflow:auto;pointer-events:auto;padding:1.4em 1.6em}
.help dl{display:grid;grid-template-columns:repeat(auto-fill,minmax(17em,1fr));gap:.1em 2em;margin:1em 0 0}
.help div.pair{display:flex;justify-content:space-between;gap:1em;padding:.3em 0;border-bottom:1px solid var(--line)}
.help dt{color:var(--muted)}
.help dd{margin:0;white-space:nowrap}
.help dd.plain{color:var(--text)}
kbd{font:inherit;font-size:.88em;background:var(--raised);border:1px solid var(--line);border-radius:.4em;
 padding:.05em .45em;margin-left:.25em}
.veil{background:color-mix(in srgb,var(--page) 55%,transparent)}
.load{position:absolute;left:50%;bottom:42%;transform:translateX(-50%);padding:.55em 1.1em;display:flex;gap:.8em;
 align-items:center;pointer-events:none;font-variant-numeric:tabular-nums}
.ring{width:1.2em;height:1.2em;border-radius:50%;border:.18em solid var(--press);border-top-color:var(--accent);
 animation:spin 1s linear infinite}
.mark{width:3.4em;height:2.8em;background:radial-gradient(circle at 70% 34%,var(--accent) 0 .85em,transparent .9em),
 radial-gradient(circle at 38% 58%,var(--muted) 0 1.15em,transparent 1.2em);opacity:.9}
@keyframes spin{to{transform:rotate(1turn)}}
.toast{position:absolute;left:50%;top:clamp(8px,1.2em,28px);transform:translateX(-50%);padding:.45em 1.1em;
 pointer-events:none;opacity:0;transition:opacity .2s;max-width:calc(100% - 2em);z-index:3;text-align:center}
.toast.on,.hint.on{opacity:1}
.hint{position:absolute;left:0;right:0;bottom:7.2em;margin:auto;width:fit-content;max-width:calc(100% - 2em);padding:.5em 1.1em;
 pointer-events:none;opacity:0;transition:opacity .4s;text-align:center;border-radius:2em}
.field.narrow,.wrap.narrow{display:none}
@container (max-width:760px){.wide{display:none!important}.field.narrow,.wrap.narrow{display:flex}
 .panel{width:100%;max-height:60cqh}
 .tool{width:2.85em;height:2.85em}}
@container (max-width:420px){.tool{width:2.6em}.stats{font-size:.8em}.time{padding:0 .2em}.speed{width:3.5em;padding:0 0 0 .2em}}
@container (max-width:379px){.speed{display:none!important}}
@container (max-width:340px){.time .of{display:none}}
@container (max-width:1000px){.roomy{display:none!important}}
@container (min-width:1001px){.panel .cramped{display:none}}
@container (max-height:299px){.root:not(.page) :is(.spare,.title){display:none!important}}
@container (max-height:300px){.panel{max-height:calc(100cqh - 5.6em)}.live .plot{display:none}}
@media (prefers-reduced-motion:reduce){*,*::before,*::after{transition:none!important;animation:none!important}}
@media (forced-colors:active){.rail>.done,.knob{background:Highlight}.card{border:1px solid CanvasText}}
.sr{position:absolute;width:1px;height:1px;overflow:hidden;clip-path:inset(50%)}
`;
