import { inBrowser, withBase } from 'vitepress';
import DefaultTheme from 'vitepress/theme';
import { h } from 'vue';
import './style.css';

/** The front page plays the bundled scene. */
const hero = () => h('splat-4d', {
  src: withBase('/scenes/knight.s4d'), autoplay: '', speed: '0.5', controls: 'none', 'aria-label': 'The bundled scene, playing',
});

export default {
  extends: DefaultTheme,
  Layout: () => h(DefaultTheme.Layout, null, { 'home-hero-image': hero }),
  enhanceApp({ router }) {
    if (!inBrowser) return;
    // The element is loaded by the first page that contains it.
    const load = () => document.querySelector('splat-4d') && import(/* @vite-ignore */ withBase('/player/element.js'));
    router.onAfterRouteChanged = () => setTimeout(load);
  },
};
