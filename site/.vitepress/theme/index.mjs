import { inBrowser, withBase } from 'vitepress';
import DefaultTheme from 'vitepress/theme';
import './style.css';

export default {
  extends: DefaultTheme,
  enhanceApp({ router }) {
    if (!inBrowser) return;
    // The element is loaded by the first page that contains it.
    const load = () => document.querySelector('splat-4d') && import(/* @vite-ignore */ withBase('/player/element.js'));
    router.onAfterRouteChanged = () => setTimeout(load);
  },
};
