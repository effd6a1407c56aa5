// What is where: the navigation of the site.

/** Crates with pages of their own, and what each is for. */
const CRATES = [
  ['splat4d', 'scenes, renderer, formats'],
  ['splat4d_train', 'captures, training'],
  ['splat4d_dynamics', 'forecasts'],
  ['splat4d_import', 'captures of videos'],
  ['splat4d_serve', 'player and server'],
  ['splat4d_workflow', 'bake, convert, evaluate, compress …'],
];
export const crates = CRATES.map(([name]) => name);

/** Pages by group: file in docs/ (or at the root) and name. */
const TUTORIALS = [
  ['docs/first-scene', 'First scene in five minutes'],
  ['docs/own-videos', 'Your own videos'],
  ['docs/own-page', 'A player on your page'],
  ['docs/own-motion-model', 'Your own motion model'],
  ['docs/own-motion-python', 'Your own motion model in Python'],
  ['docs/own-loss', 'Your own loss'],
  ['docs/from-scratch', '4D Gaussians from scratch'],
];
const GUIDES = [
  ['docs/filming', 'Film and import'],
  ['docs/assist', 'Align cameras by hand'],
  ['docs/blender', 'Render a capture in Blender'],
  ['docs/fix-capture', 'Fix a bad capture'],
  ['docs/choose-model', 'Choose a motion model'],
  ['docs/gpu', 'Use a GPU'],
  ['docs/scale', 'Train long captures'],
  ['docs/follow', 'Train while filming'],
  ['docs/refine', 'Refine cameras, localise images'],
  ['docs/shutters', 'Rolling shutter, blur, exposure'],
  ['docs/priors', 'Add depth, flow, tracks'],
  ['docs/networks', 'Compute depth, flow, masks'],
  ['docs/evaluate', 'Measure and compare runs'],
  ['docs/render', 'Render images and films'],
  ['docs/file-size', 'Limit the file size'],
  ['docs/ladder', 'Bitrate ladder'],
  ['docs/compression', 'Compress'],
  ['docs/engines', 'Hand over to another program'],
  ['docs/meshes', 'Write meshes'],
  ['docs/edit', 'Edit'],
  ['docs/labels', 'Label'],
  ['docs/track-points', 'Track points'],
  ['docs/dynamics', 'Forecast'],
];
const REFERENCE = [
  ['docs/verbs', 'Commands by example'],
  ['Command line', [
    ['docs/cli', 'import, info, train, join'],
    ['docs/cli-results', 'eval, render, predict …'],
    ['docs/cli-scenes', 'bake, compress, view, export'],
    ['docs/cli-edits', 'convert, edit, label …'],
    ['docs/exit-codes', 'Exit codes'],
    ['docs/events', 'JSON output'],
    ['docs/output-folders', 'Output folders'],
  ]],
  ['Settings', [
    ['docs/recipe', 'Run, capture, losses …'],
    ['docs/recipe-models', 'Motion models'],
    ['docs/recipe-density', 'Density control'],
  ]],
  ['Python', [
    ['docs/python', 'Python'],
    ['docs/python-api', 'Python API'],
    ['docs/python-api-scenes', 'Python API: scenes'],
  ]],
  ['docs/player', 'JavaScript: the player'],
  ['Captures', [
    ['docs/capture-format', 'capture.json'],
    ['docs/layouts', 'Layouts of other programs'],
    ['docs/doctor', 'Checks of the doctor'],
    ['docs/bundled-capture', 'The bundled capture'],
  ]],
  ['Formats', [
    ['docs/format', 'Playback file .s4d'],
    ['docs/formats', 'Formats of other programs'],
    ['docs/readers', 'Readers of .s4d'],
  ]],
  ['docs/channels', 'Channels'],
  ['docs/metrics', 'Metrics'],
];
const EXPLANATION = [
  ['docs/models', 'Motion models'],
  ['docs/method-motion', 'Equations of motion models'],
  ['docs/method-rendering', 'How rendering works'],
  ['docs/method-training', 'How training works'],
  ['docs/method-playback', 'How baking works'],
  ['docs/determinism', 'Determinism'],
  ['ARCHITECTURE', 'Architecture'],
  ['CONVENTIONS', 'Conventions'],
  ['docs/limits', 'What splat4d does not do'],
  ['docs/comparison', 'Other programs'],
  ['SECURITY', 'Security'],
];
const MEASUREMENTS = [
  ['docs/best', 'Best figures'],
  ['docs/suite', 'Suite of captures'],
  ['docs/benchmarks', 'Benchmarks'],
  ['studies/records/index', 'All records'],
];
const PROJECT = [
  ['CONTRIBUTING', 'Contributing'],
  ['docs/release', 'Release checklist'],
  ['CHANGELOG', 'Changelog'],
];

const rustdoc = () => CRATES.map(([name, what]) => ({ text: `${name}: ${what}`, link: `/api/${name}/index.html`, target: '_self' }));

export function navigation(api) {
  return [
    { text: 'Documentation', link: '/docs/' },
    { text: 'Gallery', link: '/docs/gallery' },
    { text: 'API', items: [
      { text: 'Python', link: '/docs/python-api' },
      { text: 'JavaScript', link: '/docs/player' },
      ...(api ? rustdoc() : []),
    ] },
  ];
}

/** `records`: pages and titles; `api`: whether there are pages of rustdoc; `exists`: whether a page is there. */
export function sidebar(records, api, exists) {
  const item = ([page, name]) => Array.isArray(name)
    ? { text: page, collapsed: true, items: name.map(item) }
    : { text: name, link: `/${page}` };
  const group = (text, pages, collapsed = true) => ({ text, collapsed, items: pages.map(item) });
  const rust = api ? [{ text: 'Rust', collapsed: true, items: rustdoc() }] : [];
  const reference = group('Reference', REFERENCE);
  reference.items.push(...rust);
  return [
    // The notebooks' page comes with them.
    group('Tutorials', TUTORIALS.filter(([page]) => page !== 'docs/from-scratch' || exists(`${page}.md`)), false),
    group('How-to guides', GUIDES, false),
    reference,
    group('Explanation', EXPLANATION),
    group('Records', [...MEASUREMENTS, ...records.map(([page, title]) => [page.replace(/\.md$/, ''), title])]),
    group('Project', PROJECT),
  ];
}
