"""Reads `.s4d` playback files (dynamic scenes of Gaussians) with NumPy alone.

A second implementation of the format, written from its specification (docs/format.md):

    scene = s4d.Scene.open("scene.s4d")
    g = scene.at(0.5)                     # g.position (n, 3), g.rotation (n, 4) wxyz, g.scale, g.opacity, g.base_color
    g.color([0.0, -1.0, -4.0])            # (n, 3), seen from there

`python s4d.py FILE [--time T]` describes a file; `python s4d.py --conformance FOLDER` checks the reader against a conformance set.
"""

from __future__ import annotations

import dataclasses
import json
import math
import pathlib
import struct
import sys
import zlib

import numpy as np

MAGIC = b"\x89S4D\r\n\x1a\n"
HEADER, ENTRY = 64, 64
MOST_INDEX, MOST_SECTIONS = 64 << 20, 1_000_000
MOST_ROWS, MOST_ENTRIES, MOST_KEYS, MOST_CHANNELS = 65_536, 65_536, 65_535, 64
MOST_PROVENANCE = 1 << 20
MOST_SOUND = 64 << 20
BLOCK, NUMBERS, WORDS = 256, 24, 8
RAW, DEFLATE = 0, 1
REQUIRED = 1
NONE = 0xFFFFFFFF
MOST_LOG = 40.0
# Largest ratio of sizes of one deflate stream; of a whole file, with some bytes more for small ones.
DEFLATE_MOST, FILE_MOST, FILE_SMALL = 1032, 64, 64 << 20
VISIBLE = 1.0 / 255.0
KNOWN = {b"PAGE", b"PALT", b"MASK", b"LABL", b"FEAT", b"POST", b"PROV", b"SOUN"}
# Keys that the JSON needs, and how many numbers each has; 0: one number by itself.
KEYS = {"clip": 2, "fps": 0, "up": 3, "background": 3, "sh_degree": 0, "gaussians": 0}


class Damaged(ValueError):
    """The file is not one that a reader may render: damaged, cut short, hostile or of a newer major version."""


def check(condition, what):
    if not condition:
        raise Damaged(what)


@dataclasses.dataclass
class Section:
    """An entry of the table of sections."""

    kind: bytes
    flags: int
    offset: int
    stored: int
    size: int
    crc: int
    codec: int
    number: int  # tier of a page, degree of a palette
    count: int
    words: int
    first: float
    last: float
    other: int  # the palette of a page, the page of masks, labels and features


@dataclasses.dataclass
class Palette:
    """Spherical harmonics above degree 0: `values` is (entries, K - 1, 3)."""

    degree: int
    values: np.ndarray


@dataclasses.dataclass
class Masks:
    """Bits (keys, n) at rising times (keys,)."""

    times: np.ndarray
    bits: np.ndarray

    def at(self, t):
        left = max(int(np.searchsorted(self.times, t, side="right")) - 1, 0)
        right = min(int(np.searchsorted(self.times, t, side="left")), len(self.times) - 1)
        return self.bits[left] | self.bits[right]


@dataclasses.dataclass
class Page:
    """Gaussians that are rendered for first <= t < last; arrays of n rows."""

    section: int
    first: float
    last: float
    tier: int
    mean: np.ndarray  # at `center`
    center: np.ndarray
    half_width: np.ndarray  # infinite: no end
    softness: np.ndarray
    rotation: np.ndarray  # wxyz, at `center`
    scale: np.ndarray
    opacity: np.ndarray
    velocity: np.ndarray
    turn: np.ndarray
    base_color: np.ndarray
    entry: np.ndarray
    palette: Palette | None = None
    masks: Masks | None = None
    labels: np.ndarray | None = None  # 255: none
    features: np.ndarray | None = None  # (n, channels); 0: none


@dataclasses.dataclass
class Gaussians:
    """The scene at one time: what is rendered, as arrays of n rows."""

    time: float
    position: np.ndarray  # scene units
    rotation: np.ndarray  # unit, wxyz
    scale: np.ndarray  # standard deviations, scene units
    opacity: np.ndarray  # 0 to 1, temporal opacity applied
    base_color: np.ndarray
    sh: np.ndarray  # (n, K - 1, 3) above degree 0
    page: np.ndarray  # number of the page in the table of sections
    row: np.ndarray  # in its page

    def color(self, eye):
        """Colours (n, 3) as seen from a position; at least 0, not limited above."""
        away = self.position - np.asarray(eye, float)
        length = np.linalg.norm(away, axis=1, keepdims=True)
        d = away / np.where(length > 0, length, 1)
        basis = sh_basis(d)[:, 1 : 1 + self.sh.shape[1]]
        return np.maximum(self.base_color + np.einsum("nk,nkc->nc", basis, self.sh), 0)


def sh_basis(d):
    """The 16 basis functions (n, 16) at unit directions (n, 3)."""
    x, y, z = d.T
    xx, yy, zz = x * x, y * y, z * z
    one = np.ones_like(x)
    columns = [
        0.28209479177387814 * one,
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * zz - xx - yy),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * zz - xx - yy),
        0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        -0.4570457994644658 * x * (4 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy),
    ]
    return np.stack(columns, axis=1)


def product(a, b):
    """Products of quaternions wxyz, row by row."""
    aw, ax, ay, az = a.T
    bw, bx, by, bz = b.T
    w = aw * bw - ax * bx - ay * by - az * bz
    x = aw * bx + ax * bw + ay * bz - az * by
    y = aw * by - ax * bz + ay * bw + az * bx
    z = aw * bz + ax * by - ay * bx + az * bw
    return np.stack([w, x, y, z], axis=1)


def normalized(q):
    length = np.linalg.norm(q, axis=1, keepdims=True)
    return q / np.where(length > 0, length, 1)


class Scene:
    """A whole file, decoded."""

    def __init__(self, data):
        self.data = bytes(data)
        self.version, self.length, index = header(self.data)
        check(self.length <= len(self.data), f"cut short: {len(self.data)} of {self.length} bytes")
        at, size = index
        self.meta, self.sections = parse_index(self.data[at : at + size])
        self.check_layout(at, at + size)
        self.palettes = {i: self.palette(i) for i in self.of_kind(b"PALT")}
        self.pages = [self.page(i) for i in self.of_kind(b"PAGE")]
        by_section = {p.section: p for p in self.pages}
        readers = {b"MASK": ("masks", self.masks), b"LABL": ("labels", self.labels), b"FEAT": ("features", self.features)}
        for kind, (name, reader) in readers.items():
            for i in self.of_kind(kind):
                page, section = by_section.get(self.sections[i].other), self.sections[i]
                check(page is not None and len(page.center) == section.count, f"section {i}: its page does not fit")
                check(getattr(page, name) is None, f"section {i}: a page has two sections of one kind")
                setattr(page, name, reader(i))
        total = sum(len(p.center) for p in self.pages)
        check(total == self.meta["gaussians"], f"{total} Gaussians, the JSON states {self.meta['gaussians']}")

    @classmethod
    def open(cls, path):
        return cls(pathlib.Path(path).read_bytes())

    @property
    def clip(self):
        return tuple(self.meta["clip"])

    @property
    def poster(self):
        """The bytes of the image, or None."""
        posters = self.of_kind(b"POST")
        return self.body(posters[0]) if posters else None

    @property
    def sound(self):
        """(first second, last second, the bytes of an MP4 file of AAC), or None."""
        sections = self.of_kind(b"SOUN")
        if not sections:
            return None
        section = self.sections[sections[0]]
        check(section.codec == RAW and section.stored <= MOST_SOUND, "the sound is too large or not raw")
        return section.first, section.last, self.body(sections[0])

    @property
    def provenance(self):
        """The provenance, or None."""
        sections = self.of_kind(b"PROV")
        if not sections:
            return None
        section = self.sections[sections[0]]
        check(section.codec == RAW and section.stored <= MOST_PROVENANCE, "the provenance is too large or not raw")
        return parse_json(self.body(sections[0]))

    def at(self, t):
        """What is rendered at a time (s), clamped to the clip; pages in the file's order."""
        first, last = self.clip
        t = min(max(float(t), first), last)
        parts = [part for p in self.pages if p.first <= t < p.last for part in [self.page_at(p, t)] if len(part.row)]
        width = max((part.sh.shape[1] for part in parts), default=0)
        for part in parts:
            missing = width - part.sh.shape[1]
            part.sh = np.pad(part.sh, ((0, 0), (0, missing), (0, 0)))
        empty = Gaussians(t, *(np.zeros((0, n)) for n in (3, 4, 3)), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 0, 3)),
                          np.zeros(0, int), np.zeros(0, int))
        if not parts:
            return empty
        names = [f.name for f in dataclasses.fields(Gaussians) if f.name != "time"]
        return Gaussians(t, *(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def page_at(self, page, t):
        delta = t - page.center
        late = np.maximum(np.abs(delta) - page.half_width, 0) / page.softness
        sigma = np.where(np.isinf(page.half_width), 1.0, np.exp(-0.5 * late * late))
        opacity = page.opacity * sigma
        with np.errstate(invalid="ignore", over="ignore"):
            position = page.mean + page.velocity * delta[:, None]
            turned = np.concatenate([np.zeros((len(delta), 1)), page.turn], axis=1)
            rotation = normalized(page.rotation + 0.5 * delta[:, None] * product(turned, page.rotation))
        shown = (opacity >= VISIBLE) & np.isfinite(position).all(axis=1) & np.isfinite(rotation).all(axis=1)
        if page.masks is not None:
            shown &= page.masks.at(t)
        rows = np.flatnonzero(shown)
        sh = page.palette.values[page.entry[rows]] if page.palette else np.zeros((len(rows), 0, 3))
        return Gaussians(t, position[rows], rotation[rows], page.scale[rows], opacity[rows], page.base_color[rows], sh,
                         np.full(len(rows), page.section), rows)

    # The parts of the file.

    def of_kind(self, kind):
        return [i for i, s in enumerate(self.sections) if s.kind == kind]

    def check_layout(self, index_first, index_last):
        """Sections lie within the file, apart from each other and from the index."""
        places = sorted((s.offset, s.offset + s.stored, i) for i, s in enumerate(self.sections))
        end = HEADER
        for first, last, i in places:
            check(last <= self.length, f"section {i} ends beyond the file")
            check(first >= end, f"section {i} overlaps another")
            check(last <= index_first or first >= index_last, f"section {i} overlaps the index")
            end = last
        known = [s for s in self.sections if s.kind in KNOWN]
        unpacked = sum(s.size for s in known)
        check(unpacked <= FILE_MOST * len(self.data) + FILE_SMALL, f"{len(self.data)} bytes unpack to {unpacked}")
        for i, s in enumerate(self.sections):
            if s.kind not in KNOWN:
                check(not s.flags & REQUIRED, f"section {i}: `{s.kind!r}` is not known, and required")
                continue
            check(s.codec in (RAW, DEFLATE), f"section {i}: codec {s.codec} is not known")
            most = s.stored if s.codec == RAW else s.stored * DEFLATE_MOST
            check(s.size <= most, f"section {i}: {s.size} bytes cannot be stored in {s.stored}")
            rows = s.kind in (b"PAGE", b"MASK", b"LABL", b"FEAT")
            check(not rows or 1 <= s.count <= MOST_ROWS, f"section {i}: {s.count} Gaussians")

    def body(self, i):
        """The decoded bytes of a section."""
        s = self.sections[i]
        stored = self.data[s.offset : s.offset + s.stored]
        check(zlib.crc32(stored) == s.crc, f"section {i}: wrong checksum")
        if s.codec == RAW:
            check(s.stored == s.size, f"section {i}: {s.stored} bytes instead of {s.size}")
            return stored
        stream = zlib.decompressobj(-15)
        try:
            out = stream.decompress(stored, s.size + 1)
        except zlib.error as e:
            raise Damaged(f"section {i}: {e}") from None
        check(stream.eof and len(out) == s.size, f"section {i} does not inflate to {s.size} bytes")
        return out

    def palette(self, i):
        s = self.sections[i]
        check(1 <= s.number <= 3 and 1 <= s.count <= MOST_ENTRIES, f"section {i}: degree {s.number}, {s.count} entries")
        width = (s.number + 1) ** 2 - 1
        check(s.size == 12 + 3 * width * s.count, f"section {i}: a palette of {s.size} bytes")
        body = self.body(i)
        ranges = np.frombuffer(body, "<f4", 3).astype(float)
        check(np.isfinite(ranges).all(), f"section {i}: ranges that are not finite")
        codes = np.frombuffer(body, np.uint8, offset=12).reshape(width, 3, s.count).astype(float)
        degree = [math.isqrt(k) for k in range(1, width + 1)]
        values = ranges[np.array(degree) - 1][:, None, None] * (codes - 128) / 127
        return Palette(s.number, values.transpose(2, 0, 1))

    def page(self, i):
        s = self.sections[i]
        n = s.count
        blocks = -(-n // BLOCK)
        check(s.words == WORDS, f"section {i}: {s.words} words a Gaussian")
        check(s.size == 4 * NUMBERS * blocks + 4 * WORDS * n, f"section {i}: a page of {s.size} bytes")
        check(math.isfinite(s.first) and math.isfinite(s.last) and s.first < s.last, f"section {i}: its span")
        palette = None
        if s.other != NONE:
            palette = self.palettes.get(s.other)
            check(palette is not None, f"section {i}: section {s.other} is not a palette")
        body = self.body(i)
        head = np.frombuffer(body, "<f4", NUMBERS * blocks).reshape(blocks, NUMBERS).astype(float)
        check(np.isfinite(head).all(), f"section {i}: a block header that is not finite")
        check((np.abs(head[:, [10, 11, 14, 15, 16, 17]]) <= MOST_LOG).all(), f"section {i}: a logarithm out of range")
        planes = np.frombuffer(body, np.uint8, offset=4 * NUMBERS * blocks).reshape(WORDS, 4, n).astype(np.int64)
        word = planes[:, 0] | planes[:, 1] << 8 | planes[:, 2] << 16 | planes[:, 3] << 24
        h = np.repeat(head, BLOCK, axis=0)[:n]

        def bits(w, first, count):
            return word[w] >> first & ((1 << count) - 1)

        def lerp(a, b, u):
            return h[:, a] + (h[:, b] - h[:, a]) * u

        mean = [lerp(k, k + 3, bits(k // 2, 16 * (k % 2), 16) / 65535) for k in range(3)]
        center = lerp(6, 7, bits(1, 16, 16) / 65535)
        scale = [np.exp(lerp(10, 11, bits(2, 8 * k, 8) / 255)) for k in range(3)]
        color = [lerp(18 + k, 21 + k, bits(6, 8 * k, 8) / 255) for k in range(3)]
        code = bits(6, 24, 8)
        width = np.where(code == 0, 0.0, np.exp(lerp(14, 15, (code - 1) / 253)))
        endless = code == 255
        half_width = np.where(endless, np.inf, width)
        softness = np.exp(lerp(16, 17, bits(7, 16, 8) / 255))
        span = s.last - s.first
        reach = np.where(endless, span / 2, np.minimum(np.where(endless, 0, width) + 3 * softness, span))

        def motion(w, most):
            codes = np.stack([bits(w, 10 * k, 10) for k in range(3)], axis=1)
            with np.errstate(divide="ignore", invalid="ignore"):
                return h[:, most, None] * ((codes - 511) / 511) / reach[:, None]

        others = np.stack([(bits(3, 20 - 10 * k, 10) - 511) / 511 / math.sqrt(2) for k in range(3)], axis=1)
        largest = bits(3, 30, 2)
        rotation = np.empty((n, 4))
        for k in range(4):
            rest = [j for j in range(4) if j != k]
            chosen = largest == k
            rotation[np.ix_(chosen, rest)] = others[chosen]
            rotation[chosen, k] = np.sqrt(np.maximum(1 - (others[chosen] ** 2).sum(axis=1), 0))
        entry = bits(7, 0, 16)
        if palette is not None:
            check((entry < len(palette.values)).all(), f"section {i}: an entry that its palette does not have")
        return Page(i, s.first, s.last, s.number, np.stack(mean, 1), center, half_width, softness, normalized(rotation),
                    np.stack(scale, 1), bits(2, 24, 8) / 255, motion(4, 12), motion(5, 13), np.stack(color, 1), entry, palette)

    def masks(self, i):
        s = self.sections[i]
        width = -(-s.count // 8)
        keys = (s.size - 8) // (8 + width)
        check(1 <= keys <= MOST_KEYS and s.size == 8 + keys * (8 + width), f"section {i}: masks of {s.size} bytes")
        body = self.body(i)
        check(struct.unpack_from("<I", body)[0] == keys, f"section {i}: its number of key times")
        times = np.frombuffer(body, "<f8", keys, 8)
        rising = np.isfinite(times).all() and (np.diff(times) > 0).all()
        check(rising and (times[0], times[-1]) == (s.first, s.last), f"section {i}: its key times")
        rows = np.frombuffer(body, np.uint8, offset=8 + 8 * keys).reshape(keys, width)
        bits = np.unpackbits(np.bitwise_xor.accumulate(rows, axis=0), axis=1, bitorder="little")
        return Masks(times, bits[:, : s.count].astype(bool))

    def labels(self, i):
        s = self.sections[i]
        check(s.size == s.count, f"section {i}: labels of {s.size} bytes")
        labels = np.frombuffer(self.body(i), np.uint8)
        check(((labels == 255) | (labels < len(self.meta.get("labels", [])))).all(), f"section {i}: a label without a name")
        return labels

    def features(self, i):
        s = self.sections[i]
        ranges = np.array(self.meta.get("features", []), float).reshape(-1, 2)
        check(1 <= len(ranges) <= MOST_CHANNELS and s.size == s.count * len(ranges), f"section {i}: features of {s.size} bytes")
        codes = np.frombuffer(self.body(i), np.uint8).reshape(len(ranges), s.count)
        low, high = ranges.T[:, :, None]
        return np.where(codes == 0, 0.0, low + (high - low) * ((codes - 1.0) / 254)).T


def header(data):
    """Version, length of the file and the index's place and size."""
    check(len(data) >= HEADER and data[:8] == MAGIC, "not a playback file")
    major, minor, size, length, crc, grown = struct.unpack_from("<HHIQIQ", data, 8)
    check(major in (1, 2), f"version {major}.{minor} is not known")
    check(zlib.crc32(data[:60]) == struct.unpack_from("<I", data, 60)[0], "wrong checksum of the header")
    at = grown if major == 2 else HEADER
    check(size <= MOST_INDEX and HEADER <= at and at + size <= length, "an index outside of the file")
    check(at + size <= len(data), "the index is cut short")
    check(zlib.crc32(data[at : at + size]) == crc, "wrong checksum of the index")
    return (major, minor), length, (at, size)


def parse_json(data):
    try:
        # NaN and infinity are no JSON.
        value = json.loads(data.decode(), parse_constant=lambda name: check(False, f"{name} in the JSON"))
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as e:
        raise Damaged(f"the JSON: {e}") from None
    check(isinstance(value, dict), "the JSON is not an object")
    return value


def parse_index(index):
    """The JSON and the table of sections."""
    check(len(index) >= 8, "an index without a table")
    size = struct.unpack_from("<I", index)[0]
    check(4 + size + 4 <= len(index), "the JSON is longer than the index")
    meta = parse_json(index[4 : 4 + size])
    for key, count in KEYS.items():
        value = meta.get(key)
        numbers = [value] if count == 0 else value
        check(isinstance(numbers, list) and len(numbers) == max(count, 1), f"`{key}` in the JSON")
        check(all(isinstance(x, (int, float)) and math.isfinite(x) for x in numbers), f"`{key}` in the JSON")
    check(meta["clip"][0] <= meta["clip"][1] and meta["fps"] > 0 and meta["sh_degree"] in (0, 1, 2, 3), "the JSON's numbers")
    count = struct.unpack_from("<I", index, 4 + size)[0]
    check(count <= MOST_SECTIONS and 8 + size + ENTRY * count <= len(index), f"a table of {count} sections")
    rows = struct.iter_unpack("<4sIQIIIHHIIddII", index[8 + size : 8 + size + ENTRY * count])
    return meta, [Section(*row[:-1]) for row in rows]


# The conformance set.

TOLERANCE = 1e-5


def close(a, b):
    """Whether two arrays agree within the tolerance that the set states."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    return a.shape == b.shape and bool((np.abs(a - b) <= TOLERANCE * (1 + np.abs(b))).all())


def compare(scene, want):
    """How a scene differs from the numbers of a conformance file."""
    wrong = []
    if (list(scene.version), scene.meta["gaussians"]) != (want["version"], want["records"]):
        wrong.append(f"version {scene.version}, {scene.meta['gaussians']} records")
    kinds = [s.kind.decode("ascii") for s in scene.sections]
    if kinds != want["sections"]:
        wrong.append(f"sections {kinds}")
    for moment in want["at"]:
        t = moment["time"]
        g = scene.at(t)
        if len(g.row) != moment["rendered"]:
            wrong.append(f"{len(g.row)} instead of {moment['rendered']} Gaussians at {t}")
            continue
        place = {(int(p), int(r)): i for i, (p, r) in enumerate(zip(g.page, g.row))}
        color = g.color(want["eye"])
        for page, row, *numbers in moment["gaussians"]:
            i = place.get((page, row))
            if i is None:
                wrong.append(f"Gaussian {row} of section {page} is not rendered at {t}")
                continue
            q = g.rotation[i] * (1 if g.rotation[i] @ numbers[3:7] >= 0 else -1)
            have = np.concatenate([g.position[i], q, g.scale[i], [g.opacity[i]], color[i]])
            if not close(have, numbers):
                wrong.append(f"Gaussian {row} of section {page} at {t}: {have} instead of {numbers}")
    pages = {p.section: p for p in scene.pages}
    for section, labels in want.get("labels", {}).items():
        have = pages[int(section)].labels
        if have is None or [None if x == 255 else int(x) for x in have] != labels:
            wrong.append(f"labels of section {section}")
    for section, features in want.get("features", {}).items():
        have = pages[int(section)].features
        # No features are written as an empty list.
        features = [row or [0.0] * len(scene.meta["features"]) for row in features]
        if have is None or not close(have, features):
            wrong.append(f"features of section {section}")
    return wrong


def conformance(folder):
    """Differences from the set in a folder, each with its file, and the number of files."""
    folder = pathlib.Path(folder)
    wrong, count = [], 0
    for path in sorted(folder.glob("*.json")):
        want = json.loads(path.read_text("utf-8"))
        count += 1
        try:
            wrong += [f"{want['file']}: {what}" for what in compare(Scene.open(folder / want["file"]), want)]
        except Damaged as e:
            wrong.append(f"{want['file']}: {e}")
    for name, why in json.loads((folder / "refused/refused.json").read_text("utf-8")).items():
        count += 1
        try:
            Scene.open(folder / "refused" / name)
            wrong.append(f"refused/{name}: accepted although {why}")
        except Damaged:
            pass
    return wrong, count


def main(arguments):
    if arguments[:1] == ["--conformance"] and len(arguments) == 2:
        wrong, count = conformance(arguments[1])
        print(*wrong, f"{count} files, {len(wrong)} differences", sep="\n")
        return 1 if wrong or not count else 0
    if not arguments or arguments[0].startswith("-"):
        print(__doc__)
        return 2
    try:
        scene = Scene.open(arguments[0])
    except (Damaged, OSError) as e:
        print(f"{arguments[0]}: {e}", file=sys.stderr)
        return 2
    first, last = scene.clip
    print(f"version {scene.version[0]}.{scene.version[1]}, {first:g} to {last:g} s, {scene.meta['gaussians']} records")
    times = [float(arguments[2])] if arguments[1:2] == ["--time"] else np.linspace(first, last, 5)
    for t in times:
        g = scene.at(t)
        low, high = (g.position.min(axis=0), g.position.max(axis=0)) if len(g.row) else (np.zeros(3), np.zeros(3))
        print(f"{t:8.3f} s  {len(g.row)} Gaussians in {np.round(low, 3)} to {np.round(high, 3)}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
