// Of a page in a frame: pixels beyond its width and that of its table, height of the table's head, and contrast of texts.
const parts = (colour) => colour.match(/[\d.]+/g).map(Number);
function mixed(over, under, opacity) {
  return [0, 1, 2].map((channel) => opacity * over[channel] + (1 - opacity) * under[channel]);
}
function luminance(colour) {
  const linear = colour.map((n) => n / 255).map((n) => (n <= 0.04045 ? n / 12.92 : ((n + 0.055) / 1.055) ** 2.4));
  return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2];
}
function ancestors(element) { return element ? [element, ...ancestors(element.parentElement)] : []; }
function behind(element) {
  const colours = ancestors(element).map((one) => parts(getComputedStyle(one).backgroundColor));
  return colours.find((colour) => (colour[3] ?? 1) > 0) ?? [255, 255, 255];
}
function contrast(element) {
  const style = getComputedStyle(element), ink = parts(element.ownerSVGElement ? style.fill : style.color);
  const opacity = ancestors(element).reduce((product, one) => product * getComputedStyle(one).opacity, ink[3] ?? 1);
  const paper = behind(element), [dark, light] = [paper, mixed(ink, paper, opacity)].map(luminance).sort((a, b) => a - b);
  return (light + 0.05) / (dark + 0.05);
}
onload = () => setTimeout(() => {
  const page = frames[0].document, root = page.documentElement, table = page.querySelector(".scroll");
  page.querySelectorAll("details").forEach((one) => { one.open = true; });
  const shown = [...page.body.querySelectorAll("*")].filter((one) => one.getClientRects().length);
  const texts = shown.filter((one) => [...one.childNodes].some((node) => node.nodeType === 3 && node.data.trim()));
  const found = texts.map((one) => [contrast(one), one.textContent.trim().slice(0, 30)]).sort((a, b) => a[0] - b[0]);
  Object.assign(document.body.dataset, { overflow: root.scrollWidth - root.clientWidth, texts: found.length,
    table: table ? table.scrollWidth - table.clientWidth : 0, head: table ? table.querySelector("tr").offsetHeight : 0, weakest: found[0][0].toFixed(2), words: found[0][1] });
}, 3000);
