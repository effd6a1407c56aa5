// Types of <splat-4d> in JSX, for React 19 and later: `import 'splat4d/react'` in place of `import 'splat4d'`.

import type { DetailedHTMLProps, HTMLAttributes } from 'react';
import type { Splat4D, Splat4DAttributes, Splat4DEventMap } from './element.js';

export * from './element.js';

/** Events as React passes them to custom elements: `ontimeupdate`. */
type Listeners = {
  [K in
    | 'load' | 'timeupdate' | 'play' | 'pause' | 'ended' | 'error' | 'ratechange' | 'channelchange' | 'rungchange'
    | 'camerachange' as `on${K}`]?: (event: Splat4DEventMap[K]) => void;
};

declare module 'react' {
  namespace JSX {
    interface IntrinsicElements {
      'splat-4d': DetailedHTMLProps<HTMLAttributes<Splat4D>, Splat4D> & Splat4DAttributes & Listeners;
    }
  }
}
