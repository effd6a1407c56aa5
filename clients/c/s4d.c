/* libs4d; s4d.h has the interface, docs/format.md the format. */

#include "s4d.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum {
    HEADER_BYTES = 64,
    ENTRY_BYTES = 64,
    BLOCK = 256,
    BLOCK_NUMBERS = 24,
    BLOCK_BYTES = 4 * BLOCK_NUMBERS,
    WORDS = 8,
    MOST_ROWS = 65536,
    MOST_ENTRIES = 65536,
    MOST_KEYS = 65535,
    MOST_CHANNELS = 64,
    /* The byte of a Gaussian without a label, so that there are at most this many. */
    MOST_LABELS = 255,
    CODEC_RAW = 0,
    CODEC_DEFLATE = 1,
    FLAG_REQUIRED = 1,
    /* Deflate shrinks at most 1 : 1032. */
    MOST_DEFLATE = 1032,
    /* Nested arrays and objects of the JSON. */
    MOST_DEPTH = 100
};
#define MOST_INDEX ((uint32_t)64 << 20)
#define MOST_SECTIONS ((uint32_t)1000000)
#define NO_PALETTE ((uint32_t)0xFFFFFFFF)
#define MOST_LOG 40.0
#define VISIBLE (1.0 / 255.0)
#define SQRT_HALF 0.70710678118654752440

/* ---- Numbers of the file ---- */

static uint32_t u16_at(const uint8_t *p) { return (uint32_t)p[0] | (uint32_t)p[1] << 8; }
static uint32_t u32_at(const uint8_t *p) { return u16_at(p) | u16_at(p + 2) << 16; }
static uint64_t u64_at(const uint8_t *p) { return (uint64_t)u32_at(p) | (uint64_t)u32_at(p + 4) << 32; }

static double f64_at(const uint8_t *p) {
    uint64_t bits = u64_at(p);
    double x;
    memcpy(&x, &bits, sizeof x);
    return x;
}

static double f32_at(const uint8_t *p) {
    uint32_t bits = u32_at(p);
    float x;
    memcpy(&x, &bits, sizeof x);
    return x;
}

/* x - x is NaN for infinities and NaN. */
static int finite_number(double x) { return x - x == 0.0; }

static uint32_t crc32_of(const uint8_t *p, size_t size) {
    /* Four bits at a time; the polynomial is 0xEDB88320. */
    static const uint32_t table[16] = {0x00000000, 0x1DB71064, 0x3B6E20C8, 0x26D930AC, 0x76DC4190, 0x6B6B51F4,
                                       0x4DB26158, 0x5005713C, 0xEDB88320, 0xF00F9344, 0xD6D6A3E8, 0xCB61B38C,
                                       0x9B64C2B0, 0x86D3D2D4, 0xA00AE278, 0xBDBDF21C};
    uint32_t crc = 0xFFFFFFFF;
    for (size_t i = 0; i < size; i++) {
        crc ^= p[i];
        crc = crc >> 4 ^ table[crc & 15];
        crc = crc >> 4 ^ table[crc & 15];
    }
    return ~crc;
}

/* ---- Inflate (RFC 1951) ---- */

enum { CODE_BITS = 15, FAST_BITS = 10, LITERALS = 288, DISTANCES = 32 };

typedef struct bits {
    const uint8_t *next, *end;
    uint64_t held;
    unsigned count;
    int failed;
} bits;

/* Prefix codes: how many of each length, symbols in the order of codes, and a table by the next FAST_BITS bits, whose entries are
 * symbol << 4 | length, or 0 for longer codes. */
typedef struct codes {
    uint16_t count[CODE_BITS + 1], symbol[LITERALS], fast[1 << FAST_BITS];
} codes;

static void refill(bits *b) {
    while (b->count <= 56 && b->next < b->end) {
        b->held |= (uint64_t)*b->next++ << b->count;
        b->count += 8;
    }
}

static uint32_t take(bits *b, unsigned n) {
    if (b->count < n) {
        refill(b);
        if (b->count < n) {
            b->failed = 1;
            return 0;
        }
    }
    uint32_t value = (uint32_t)(b->held & (((uint64_t)1 << n) - 1));
    b->held >>= n;
    b->count -= n;
    return value;
}

/* Builds codes of lengths; 0: more codes than there are, or too few. */
static int build(codes *c, const uint8_t *lengths, unsigned n, int may_miss) {
    uint16_t first[CODE_BITS + 2];
    int left = 1;
    memset(c, 0, sizeof *c);
    for (unsigned i = 0; i < n; i++) c->count[lengths[i]]++;
    c->count[0] = 0;
    unsigned used = 0;
    for (unsigned length = 1; length <= CODE_BITS; length++) {
        left = 2 * left - c->count[length];
        if (left < 0) return 0;
        used += c->count[length];
    }
    /* Only a single code of one bit, or none, may leave others unused. */
    if (left > 0 && !(may_miss && used <= 1 && c->count[1] == used)) return 0;
    first[1] = 0;
    for (unsigned length = 1; length <= CODE_BITS; length++) first[length + 1] = (uint16_t)(first[length] + c->count[length]);
    uint16_t place[CODE_BITS + 2];
    memcpy(place, first, sizeof place);
    for (unsigned i = 0; i < n; i++)
        if (lengths[i]) c->symbol[place[lengths[i]]++] = (uint16_t)i;
    uint32_t code = 0;
    for (unsigned length = 1; length <= FAST_BITS; length++) {
        for (unsigned i = 0; i < c->count[length]; i++, code++) {
            uint32_t reversed = 0;
            for (unsigned k = 0; k < length; k++) reversed |= (code >> k & 1) << (length - 1 - k);
            uint16_t entry = (uint16_t)((unsigned)c->symbol[first[length] + i] << 4 | length);
            for (uint32_t at = reversed; at < 1u << FAST_BITS; at += 1u << length) c->fast[at] = entry;
        }
        code <<= 1;
    }
    return 1;
}

/* The next symbol; a failed stream gives 0. */
static unsigned symbol(bits *b, const codes *c) {
    if (b->count < CODE_BITS) refill(b);
    uint16_t entry = c->fast[b->held & ((1 << FAST_BITS) - 1)];
    if (entry && (entry & 15u) <= b->count) {
        b->held >>= entry & 15;
        b->count -= entry & 15;
        return entry >> 4;
    }
    uint32_t code = 0, first = 0, index = 0;
    for (unsigned length = 1; length <= CODE_BITS; length++) {
        code |= take(b, 1);
        if (b->failed) return 0;
        uint32_t count = c->count[length];
        if (code - first < count) return c->symbol[index + (code - first)];
        index += count;
        first = (first + count) << 1;
        code <<= 1;
    }
    b->failed = 1;
    return 0;
}

static int dynamic_codes(bits *b, codes *literals, codes *distances) {
    static const uint8_t order[19] = {16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15};
    uint8_t lengths[LITERALS + DISTANCES] = {0};
    unsigned nl = take(b, 5) + 257, nd = take(b, 5) + 1, nc = take(b, 4) + 4;
    if (b->failed || nl > 286 || nd > 30) return 0;
    for (unsigned i = 0; i < nc; i++) lengths[order[i]] = (uint8_t)take(b, 3);
    if (b->failed || !build(literals, lengths, 19, 0)) return 0;
    memset(lengths, 0, sizeof lengths);
    for (unsigned i = 0; i < nl + nd;) {
        unsigned s = symbol(b, literals), repeat = 1;
        uint8_t length = (uint8_t)s;
        if (b->failed) return 0;
        if (s == 16) {
            if (i == 0) return 0;
            length = lengths[i - 1];
            repeat = 3 + take(b, 2);
        } else if (s == 17) {
            length = 0;
            repeat = 3 + take(b, 3);
        } else if (s == 18) {
            length = 0;
            repeat = 11 + take(b, 7);
        }
        if (b->failed || i + repeat > nl + nd) return 0;
        while (repeat--) lengths[i++] = length;
    }
    return lengths[256] && build(literals, lengths, nl, 0) && build(distances, lengths + nl, nd, 1);
}

static void fixed_codes(codes *literals, codes *distances) {
    uint8_t lengths[LITERALS];
    for (unsigned i = 0; i < LITERALS; i++) lengths[i] = i < 144 ? 8 : i < 256 ? 9 : i < 280 ? 7 : 8;
    build(literals, lengths, LITERALS, 0);
    memset(lengths, 5, DISTANCES);
    build(distances, lengths, DISTANCES, 0);
}

/* Inflates to exactly `size` bytes; 0: the stream does not give them. `work` are two codes. */
static int inflate_to(const uint8_t *in, size_t in_size, uint8_t *out, size_t size, codes *work) {
    static const uint16_t base[29] = {3,  4,  5,  6,  7,  8,  9,  10, 11,  13,  15,  17,  19,  23, 27,
                                      31, 35, 43, 51, 59, 67, 83, 99, 115, 131, 163, 195, 227, 258};
    static const uint8_t extra[29] = {0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3, 4, 4, 4, 4, 5, 5, 5, 5, 0};
    static const uint16_t far[30] = {1,   2,   3,   4,   5,   7,    9,    13,   17,   25,   33,   49,   65,    97,    129,
                                     193, 257, 385, 513, 769, 1025, 1537, 2049, 3073, 4097, 6145, 8193, 12289, 16385, 24577};
    static const uint8_t more[30] = {0, 0, 0, 0, 1, 1, 2, 2,  3,  3,  4,  4,  5,  5,  6,
                                     6, 7, 7, 8, 8, 9, 9, 10, 10, 11, 11, 12, 12, 13, 13};
    bits b = {in, in + in_size, 0, 0, 0};
    codes *literals = work, *distances = work + 1;
    size_t done = 0;
    int last;
    do {
        last = (int)take(&b, 1);
        unsigned kind = take(&b, 2);
        if (b.failed || kind == 3) return 0;
        if (kind == 0) {
            (void)take(&b, b.count & 7);
            uint32_t n = take(&b, 16), check = take(&b, 16);
            if (b.failed || n != (check ^ 0xFFFF) || n > size - done) return 0;
            while (n > 0 && b.count >= 8) {
                out[done++] = (uint8_t)take(&b, 8);
                n--;
            }
            if ((size_t)(b.end - b.next) < n) return 0;
            if (n > 0) memcpy(out + done, b.next, n);
            b.next += n;
            done += n;
            continue;
        }
        if (kind == 1)
            fixed_codes(literals, distances);
        else if (!dynamic_codes(&b, literals, distances))
            return 0;
        for (;;) {
            unsigned s = symbol(&b, literals);
            if (b.failed) return 0;
            if (s == 256) break;
            if (s < 256) {
                if (done == size) return 0;
                out[done++] = (uint8_t)s;
                continue;
            }
            if (s > 285) return 0;
            size_t length = base[s - 257] + take(&b, extra[s - 257]);
            unsigned d = symbol(&b, distances);
            if (b.failed || d > 29) return 0;
            size_t distance = far[d] + take(&b, more[d]);
            if (b.failed || distance > done || length > size - done) return 0;
            for (; length > 0; length--, done++) out[done] = out[done - distance];
        }
    } while (!last);
    return done == size;
}

/* ---- JSON: checked as a whole; a few keys of the outermost object are kept ---- */

typedef struct text {
    const char *next, *end;
} text;

static void space(text *t) {
    while (t->next < t->end && (*t->next == ' ' || *t->next == '\t' || *t->next == '\n' || *t->next == '\r')) t->next++;
}

static int sign(text *t, char c) {
    space(t);
    if (t->next == t->end || *t->next != c) return 0;
    t->next++;
    return 1;
}

static int word(text *t, const char *w) {
    size_t n = strlen(w);
    if ((size_t)(t->end - t->next) < n || memcmp(t->next, w, n) != 0) return 0;
    t->next += n;
    return 1;
}

/* A string without its quotes. */
static int string(text *t, const char **first, size_t *size) {
    if (!sign(t, '"')) return 0;
    *first = t->next;
    while (t->next < t->end && *t->next != '"') {
        if ((unsigned char)*t->next < 0x20) return 0;
        if (*t->next == '\\') {
            if (++t->next == t->end || !strchr("\"\\/bfnrtu", *t->next) || *t->next == 0) return 0;
        }
        t->next++;
    }
    if (t->next == t->end) return 0;
    *size = (size_t)(t->next - *first);
    t->next++;
    return 1;
}

static int digit(const text *t) { return t->next < t->end && *t->next >= '0' && *t->next <= '9'; }

/* Independent of the locale. Up to 15 digits and powers up to 22 are exact, more are right to a unit in the last place. */
static int number(text *t, double *out) {
    static const double powers[23] = {1e0,  1e1,  1e2,  1e3,  1e4,  1e5,  1e6,  1e7,  1e8,  1e9,  1e10, 1e11,
                                      1e12, 1e13, 1e14, 1e15, 1e16, 1e17, 1e18, 1e19, 1e20, 1e21, 1e22};
    uint64_t digits = 0;
    int power = 0, exponent = 0, negative, less = 0, some = 0;
    space(t);
    negative = t->next < t->end && *t->next == '-';
    if (negative) t->next++;
    for (; digit(t); t->next++, some = 1) {
        if (digits < UINT64_MAX / 10 - 9)
            digits = digits * 10 + (uint64_t)(*t->next - '0');
        else if (power < 100000)
            power++;
    }
    if (!some) return 0;
    if (t->next < t->end && *t->next == '.') {
        t->next++;
        if (!digit(t)) return 0;
        for (; digit(t); t->next++) {
            if (digits < UINT64_MAX / 10 - 9) {
                digits = digits * 10 + (uint64_t)(*t->next - '0');
                if (power > -100000) power--;
            }
        }
    }
    if (t->next < t->end && (*t->next == 'e' || *t->next == 'E')) {
        t->next++;
        if (t->next < t->end && (*t->next == '+' || *t->next == '-')) less = *t->next++ == '-';
        if (!digit(t)) return 0;
        for (; digit(t); t->next++)
            if (exponent < 100000) exponent = 10 * exponent + (*t->next - '0');
    }
    power += less ? -exponent : exponent;
    double x = (double)digits;
    /* Further than this everything is zero or infinite. */
    if (power > 400) power = 400;
    if (power < -400) power = -400;
    for (; power > 0; power -= power > 22 ? 22 : power) x *= powers[power > 22 ? 22 : power];
    for (; power < 0; power += power < -22 ? 22 : -power) x /= powers[power < -22 ? 22 : -power];
    *out = negative ? -x : x;
    return finite_number(x);
}

/* Skips any value. */
static int value(text *t, int depth) {
    const char *s;
    size_t n;
    double x;
    space(t);
    if (t->next == t->end || depth > MOST_DEPTH) return 0;
    switch (*t->next) {
    case '"':
        return string(t, &s, &n);
    case '{':
    case '[': {
        char close = *t->next++ == '{' ? '}' : ']';
        if (sign(t, close)) return 1;
        do {
            if (close == '}' && !(string(t, &s, &n) && sign(t, ':'))) return 0;
            if (!value(t, depth + 1)) return 0;
        } while (sign(t, ','));
        return sign(t, close);
    }
    case 't':
        return word(t, "true");
    case 'f':
        return word(t, "false");
    case 'n':
        return word(t, "null");
    default:
        return number(t, &x);
    }
}

static int numbers(text *t, double *out, unsigned n) {
    if (!sign(t, '[')) return 0;
    for (unsigned i = 0; i < n; i++)
        if ((i > 0 && !sign(t, ',')) || !number(t, out + i)) return 0;
    return sign(t, ']');
}

/* ---- The file ---- */

typedef struct section {
    uint8_t kind[4];
    uint32_t flags, stored, size, crc, codec, number, count, words, other;
    uint64_t offset;
    double from, to;
} section;

/* A decoded Gaussian. Times in double precision: they are subtracted. */
typedef struct record {
    double center, half_width, softness;
    float mean[3], quat[4], scale[3], opacity, velocity[3], turn[3], color[3];
    uint16_t entry;
} record;

/* What is kept of a page: `rows` of `count` records; which of them are rendered, in order. */
typedef struct page {
    uint32_t section, count, shown;
    record *rows;
    uint16_t *visible;
    /* Decoded sections of the page; NULL: it has none. */
    uint8_t *masks, *labels, *features;
    uint32_t mask_section, label_section, feature_section;
} page;

struct s4d_file {
    const uint8_t *bytes;
    size_t size;
    s4d_info info;
    section *sections;
    uint32_t section_count;
    /* By section: decoded palettes, and pages; NULL where they are not needed now. */
    uint8_t **palettes;
    page *pages;
    uint32_t page_count;
    double time;
    size_t rendered;
    double ranges[MOST_CHANNELS][2];
    const char *labels;
    codes *work;
};

static int is(const section *s, const char *kind) { return memcmp(s->kind, kind, 4) == 0; }

static int of_page(const section *s) { return is(s, "MASK") || is(s, "LABL") || is(s, "FEAT"); }

static int known(const section *s) {
    return is(s, "PAGE") || is(s, "PALT") || of_page(s) || is(s, "POST") || is(s, "PROV") || is(s, "SOUN");
}

const char *s4d_text(s4d_status status) {
    switch (status) {
    case S4D_OK: return "no error";
    case S4D_ARGUMENT: return "invalid argument";
    case S4D_MEMORY: return "out of memory";
    case S4D_FOREIGN: return "not a playback file (.s4d)";
    case S4D_NEWER: return "the playback file needs a newer reader";
    case S4D_SHORT: return "the playback file is cut short";
    case S4D_DAMAGED: return "the playback file is damaged";
    case S4D_TOO_LARGE: return "the playback file unpacks to more than it may";
    }
    return "unknown status";
}

static s4d_status parse_json(s4d_file *f) {
    enum { CLIP = 1, FPS = 2, UP = 4, BACKGROUND = 8, DEGREE = 16, RECORDS = 32, ALL = 63 };
    text t = {f->info.json, f->info.json + f->info.json_size};
    int found = 0;
    if (!sign(&t, '{')) return S4D_DAMAGED;
    if (!sign(&t, '}')) {
        do {
            const char *key;
            size_t n;
            double x = 0;
            int ok = 1;
            if (!string(&t, &key, &n) || !sign(&t, ':')) return S4D_DAMAGED;
            space(&t);
            int null = t.next < t.end && *t.next == 'n';
#define KEY(name) (n == sizeof name - 1 && memcmp(key, name, n) == 0)
            if (KEY("clip")) {
                ok = numbers(&t, f->info.clip, 2);
                found |= CLIP;
            } else if (KEY("fps")) {
                ok = number(&t, &f->info.fps);
                found |= FPS;
            } else if (KEY("up")) {
                ok = numbers(&t, f->info.up, 3);
                found |= UP;
            } else if (KEY("background")) {
                ok = numbers(&t, f->info.background, 3);
                found |= BACKGROUND;
            } else if (KEY("sh_degree")) {
                ok = number(&t, &x) && (x == 0 || x == 1 || x == 2 || x == 3);
                f->info.sh_degree = ok ? (unsigned)x : 0;
                found |= DEGREE;
            } else if (KEY("gaussians")) {
                ok = number(&t, &x) && x >= 0 && x < 9007199254740992.0 && x == floor(x);
                f->info.records = ok ? (uint64_t)x : 0;
                found |= RECORDS;
            } else if (KEY("unit") && !null) {
                ok = number(&t, &f->info.unit) && f->info.unit > 0;
            } else if (KEY("offset")) {
                ok = numbers(&t, f->info.offset, 3);
            } else if (KEY("labels")) {
                f->labels = t.next;
                ok = sign(&t, '[');
                if (ok && !sign(&t, ']')) {
                    do {
                        ok = string(&t, &key, &n) && ++f->info.labels <= MOST_LABELS;
                    } while (ok && sign(&t, ','));
                    ok = ok && sign(&t, ']');
                }
            } else if (KEY("features")) {
                ok = sign(&t, '[');
                if (ok && !sign(&t, ']')) {
                    do {
                        ok = f->info.features < MOST_CHANNELS && numbers(&t, f->ranges[f->info.features], 2);
                        f->info.features++;
                    } while (ok && sign(&t, ','));
                    ok = ok && sign(&t, ']');
                }
            } else {
                ok = value(&t, 1);
            }
#undef KEY
            if (!ok) return S4D_DAMAGED;
        } while (sign(&t, ','));
        if (!sign(&t, '}')) return S4D_DAMAGED;
    }
    space(&t);
    int sound = t.next == t.end && found == ALL && f->info.clip[0] <= f->info.clip[1] && f->info.fps > 0;
    return sound ? S4D_OK : S4D_DAMAGED;
}

static uint32_t key_times(const section *s) {
    uint32_t key = 8 + (s->count + 7) / 8;
    if (s->size < 8 || (s->size - 8) % key) return 0;
    uint32_t keys = (s->size - 8) / key;
    return keys <= MOST_KEYS ? keys : 0;
}

static s4d_status check_section(const s4d_file *f, const section *s) {
    if (!known(s)) return s->flags & FLAG_REQUIRED ? S4D_NEWER : S4D_OK;
    if (s->codec != CODEC_RAW && s->codec != CODEC_DEFLATE) return S4D_NEWER;
    uint64_t most = (uint64_t)s->stored * (s->codec == CODEC_RAW ? 1 : MOST_DEFLATE);
    if (s->size > most) return S4D_DAMAGED;
    int span = finite_number(s->from) && finite_number(s->to);
    if ((is(s, "PAGE") || of_page(s)) && (s->count < 1 || s->count > MOST_ROWS)) return S4D_DAMAGED;
    if (is(s, "PAGE")) {
        if (s->words != WORDS) return S4D_NEWER;
        if (s->size != (s->count + BLOCK - 1) / BLOCK * BLOCK_BYTES + s->count * 4 * WORDS) return S4D_DAMAGED;
        if (!span || s->from >= s->to) return S4D_DAMAGED;
        if (s->other != NO_PALETTE && (s->other >= f->section_count || !is(&f->sections[s->other], "PALT"))) return S4D_DAMAGED;
    } else if (is(s, "PALT")) {
        if (s->number < 1 || s->number > 3 || s->count < 1 || s->count > MOST_ENTRIES) return S4D_DAMAGED;
        if (s->size != 12 + 3 * ((s->number + 1) * (s->number + 1) - 1) * s->count) return S4D_DAMAGED;
    } else if (is(s, "MASK")) {
        if (!key_times(s) || !span || s->from > s->to) return S4D_DAMAGED;
    } else if (is(s, "LABL")) {
        if (s->size != s->count) return S4D_DAMAGED;
    } else if (is(s, "FEAT")) {
        if (!f->info.features || s->size != s->count * f->info.features) return S4D_DAMAGED;
    }
    return S4D_OK;
}

typedef struct place {
    uint64_t from, to;
} place;

static int by_place(const void *a, const void *b) {
    const place *p = a, *q = b;
    if (p->from != q->from) return p->from < q->from ? -1 : 1;
    return p->to < q->to ? -1 : p->to > q->to;
}

/* Sections lie within the file, apart from the index and from each other. */
static s4d_status check_places(const s4d_file *f, uint64_t length, uint64_t index, uint64_t index_end) {
    if (f->section_count == 0) return S4D_OK;
    place *all = malloc(f->section_count * sizeof *all);
    if (!all) return S4D_MEMORY;
    s4d_status status = S4D_OK;
    for (uint32_t i = 0; i < f->section_count && status == S4D_OK; i++) {
        const section *s = &f->sections[i];
        all[i].from = s->offset;
        all[i].to = s->offset + s->stored;
        if (s->offset > length || s->stored > length - s->offset) status = S4D_DAMAGED;
        else if (all[i].to > index && s->offset < index_end) status = S4D_DAMAGED;
    }
    if (status == S4D_OK) {
        uint64_t end = HEADER_BYTES;
        qsort(all, f->section_count, sizeof *all, by_place);
        for (uint32_t i = 0; i < f->section_count; i++) {
            if (all[i].from < end) status = S4D_DAMAGED;
            end = all[i].to;
        }
    }
    free(all);
    return status;
}

static s4d_status parse(s4d_file *f) {
    static const uint8_t magic[8] = {0x89, 'S', '4', 'D', '\r', '\n', 0x1A, '\n'};
    const uint8_t *h = f->bytes;
    size_t known_magic = f->size < 8 ? f->size : 8;
    if (memcmp(h, magic, known_magic) != 0) return S4D_FOREIGN;
    if (f->size < HEADER_BYTES) return S4D_SHORT;
    f->info.major = u16_at(h + 8);
    f->info.minor = u16_at(h + 10);
    if (f->info.major != 1 && f->info.major != 2) return S4D_NEWER;
    if (crc32_of(h, 60) != u32_at(h + 60)) return S4D_DAMAGED;
    uint32_t index_size = u32_at(h + 12);
    uint64_t length = u64_at(h + 16), index = f->info.major == 2 ? u64_at(h + 28) : HEADER_BYTES;
    if (index_size < 8 || index_size > MOST_INDEX || index < HEADER_BYTES || index > length || index_size > length - index)
        return S4D_DAMAGED;
    if (index > f->size || index_size > f->size - index) return S4D_SHORT;
    const uint8_t *p = f->bytes + index;
    if (crc32_of(p, index_size) != u32_at(h + 24)) return S4D_DAMAGED;
    uint32_t json_size = u32_at(p);
    if (json_size > index_size - 8) return S4D_DAMAGED;
    f->info.json = (const char *)p + 4;
    f->info.json_size = json_size;
    s4d_status status = parse_json(f);
    if (status != S4D_OK) return status;
    uint32_t count = u32_at(p + 4 + json_size);
    if (count > MOST_SECTIONS || count > (index_size - 8 - json_size) / ENTRY_BYTES) return S4D_DAMAGED;
    f->section_count = count;
    f->sections = calloc(count ? count : 1, sizeof *f->sections);
    f->palettes = calloc(count ? count : 1, sizeof *f->palettes);
    if (!f->sections || !f->palettes) return S4D_MEMORY;
    const uint8_t *e = p + 8 + json_size;
    for (uint32_t i = 0; i < count; i++, e += ENTRY_BYTES) {
        section *s = &f->sections[i];
        memcpy(s->kind, e, 4);
        s->flags = u32_at(e + 4);
        s->offset = u64_at(e + 8);
        s->stored = u32_at(e + 16);
        s->size = u32_at(e + 20);
        s->crc = u32_at(e + 24);
        s->codec = u16_at(e + 28);
        s->number = u16_at(e + 30);
        s->count = u32_at(e + 32);
        s->words = u32_at(e + 36);
        s->from = f64_at(e + 40);
        s->to = f64_at(e + 48);
        s->other = u32_at(e + 56);
    }
    status = check_places(f, length, index, index + index_size);
    if (status != S4D_OK) return status;
    uint64_t records = 0, unpacked = 0;
    uint32_t pages = 0;
    for (uint32_t i = 0; i < count; i++) {
        const section *s = &f->sections[i];
        status = check_section(f, s);
        if (status != S4D_OK) return status;
        if (known(s)) unpacked += s->size;
        if (is(s, "PAGE")) {
            records += s->count;
            pages++;
        }
    }
    if (records != f->info.records) return S4D_DAMAGED;
    if (unpacked > S4D_MOST_GROWTH * (uint64_t)f->size + S4D_SMALL) return S4D_TOO_LARGE;
    f->pages = calloc(pages ? pages : 1, sizeof *f->pages);
    /* By section: its page + 1. */
    uint32_t *of = calloc(count ? count : 1, sizeof *of);
    if (!f->pages || !of) {
        free(of);
        return S4D_MEMORY;
    }
    for (uint32_t i = 0; i < count; i++) {
        if (!is(&f->sections[i], "PAGE")) continue;
        page *q = &f->pages[f->page_count++];
        q->section = i;
        q->count = f->sections[i].count;
        q->mask_section = q->label_section = q->feature_section = NO_PALETTE;
        of[i] = f->page_count;
    }
    for (uint32_t i = 0; i < count && status == S4D_OK; i++) {
        const section *s = &f->sections[i];
        if (!of_page(s)) continue;
        page *q = s->other < count && of[s->other] ? &f->pages[of[s->other] - 1] : NULL;
        uint32_t *slot = !q ? NULL : is(s, "MASK") ? &q->mask_section : is(s, "LABL") ? &q->label_section : &q->feature_section;
        if (!q || q->count != s->count || *slot != NO_PALETTE)
            status = S4D_DAMAGED;
        else
            *slot = i;
    }
    free(of);
    f->time = f->info.clip[0];
    return status;
}

s4d_status s4d_open(const void *bytes, size_t size, s4d_file **file) {
    if (!file) return S4D_ARGUMENT;
    *file = NULL;
    if (!bytes) return S4D_ARGUMENT;
    s4d_file *f = calloc(1, sizeof *f);
    if (!f) return S4D_MEMORY;
    f->bytes = bytes;
    f->size = size;
    f->work = malloc(2 * sizeof *f->work);
    s4d_status status = f->work ? parse(f) : S4D_MEMORY;
    if (status != S4D_OK) {
        s4d_close(f);
        return status;
    }
    *file = f;
    return S4D_OK;
}

static void forget(page *p) {
    free(p->rows);
    free(p->visible);
    free(p->masks);
    free(p->labels);
    free(p->features);
    p->rows = NULL;
    p->visible = NULL;
    p->masks = p->labels = p->features = NULL;
    p->shown = 0;
}

void s4d_close(s4d_file *f) {
    if (!f) return;
    for (uint32_t i = 0; i < f->page_count; i++) forget(&f->pages[i]);
    for (uint32_t i = 0; f->palettes && i < f->section_count; i++) free(f->palettes[i]);
    free(f->pages);
    free(f->palettes);
    free(f->sections);
    free(f->work);
    free(f);
}

const s4d_info *s4d_get_info(const s4d_file *f) { return f ? &f->info : NULL; }

size_t s4d_sections(const s4d_file *f) { return f ? f->section_count : 0; }

s4d_status s4d_get_section(const s4d_file *f, size_t i, s4d_section *out) {
    if (!f || !out || i >= f->section_count) return S4D_ARGUMENT;
    const section *s = &f->sections[i];
    memcpy(out->kind, s->kind, 4);
    out->offset = s->offset;
    out->stored = s->stored;
    out->size = s->size;
    out->number = s->number;
    out->count = s->count;
    out->from = s->from;
    out->to = s->to;
    return S4D_OK;
}

/* The decoded bytes of a section, to be freed. */
static s4d_status body(const s4d_file *f, uint32_t i, uint8_t **out) {
    const section *s = &f->sections[i];
    *out = NULL;
    if (s->offset > f->size || s->stored > f->size - s->offset) return S4D_SHORT;
    const uint8_t *stored = f->bytes + s->offset;
    if (crc32_of(stored, s->stored) != s->crc) return S4D_DAMAGED;
    if (s->codec == CODEC_RAW && s->stored != s->size) return S4D_DAMAGED;
    uint8_t *bytes = malloc(s->size ? s->size : 1);
    if (!bytes) return S4D_MEMORY;
    if (s->codec == CODEC_RAW) {
        if (s->size > 0) memcpy(bytes, stored, s->size);
    } else if (!inflate_to(stored, s->stored, bytes, s->size, f->work)) {
        free(bytes);
        return S4D_DAMAGED;
    }
    *out = bytes;
    return S4D_OK;
}

static s4d_status decode_palette(s4d_file *f, uint32_t i) {
    if (f->palettes[i]) return S4D_OK;
    s4d_status status = body(f, i, &f->palettes[i]);
    for (int k = 0; status == S4D_OK && k < 3; k++)
        if (!finite_number(f32_at(f->palettes[i] + 4 * k))) status = S4D_DAMAGED;
    if (status != S4D_OK) {
        free(f->palettes[i]);
        f->palettes[i] = NULL;
    }
    return status;
}

static double lerp(double a, double b, double u) { return a + (b - a) * u; }

static void normalize(double *q) {
    double length = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    for (int k = 0; k < 4; k++) q[k] = length > 0 ? q[k] / length : k == 0;
}

/* A number as single precision holds it. Larger ones become infinite, which is not rendered. */
static float single(double x) { return x > 3.4028234e38 ? (float)HUGE_VAL : x < -3.4028234e38 ? (float)-HUGE_VAL : (float)x; }

static void decode_record(const uint32_t *w, const double *h, double from, double to, record *r) {
    uint32_t width = w[6] >> 24, largest = w[3] >> 30;
    double q[4], sum = 0;
    for (unsigned k = 0; k < 3; k++) {
        r->mean[k] = single(lerp(h[k], h[3 + k], (w[k / 2] >> 16 * (k % 2) & 0xFFFF) / 65535.0));
        r->scale[k] = single(exp(lerp(h[10], h[11], (w[2] >> 8 * k & 255) / 255.0)));
        r->color[k] = single(lerp(h[18 + k], h[21 + k], (w[6] >> 8 * k & 255) / 255.0));
    }
    r->center = lerp(h[6], h[7], (w[1] >> 16) / 65535.0);
    r->opacity = (float)((w[2] >> 24) / 255.0);
    r->softness = exp(lerp(h[16], h[17], (w[7] >> 16 & 255) / 255.0));
    r->half_width = width == 255 ? HUGE_VAL : width == 0 ? 0 : exp(lerp(h[14], h[15], (width - 1) / 253.0));
    r->entry = (uint16_t)(w[7] & 0xFFFF);
    double span = to - from, reach = span / 2;
    if (width != 255) {
        reach = r->half_width + 3 * r->softness;
        if (reach > span) reach = span;
    }
    for (unsigned k = 0, other = 0; k < 4; k++) {
        if (k == largest) continue;
        q[k] = ((double)(w[3] >> (20 - 10 * other++) & 1023) - 511) / 511 * SQRT_HALF;
        sum += q[k] * q[k];
    }
    q[largest] = sum < 1 ? sqrt(1 - sum) : 0;
    normalize(q);
    for (unsigned k = 0; k < 4; k++) r->quat[k] = (float)q[k];
    for (unsigned k = 0; k < 3; k++) {
        double shift = h[12] * (((double)(w[4] >> 10 * k & 1023) - 511) / 511);
        double turn = h[13] * (((double)(w[5] >> 10 * k & 1023) - 511) / 511);
        r->velocity[k] = single(reach > 0 ? shift / reach : HUGE_VAL);
        r->turn[k] = single(reach > 0 ? turn / reach : HUGE_VAL);
    }
}

static s4d_status decode_masks(const s4d_file *f, page *p) {
    const section *s = &f->sections[p->mask_section];
    s4d_status status = body(f, p->mask_section, &p->masks);
    if (status != S4D_OK) return status;
    uint32_t keys = key_times(s), width = (s->count + 7) / 8;
    if (u32_at(p->masks) != keys) return S4D_DAMAGED;
    const uint8_t *times = p->masks + 8;
    if (f64_at(times) != s->from || f64_at(times + 8 * (size_t)(keys - 1)) != s->to) return S4D_DAMAGED;
    for (uint32_t k = 1; k < keys; k++)
        if (!(f64_at(times + 8 * (size_t)(k - 1)) < f64_at(times + 8 * (size_t)k))) return S4D_DAMAGED;
    uint8_t *rows = p->masks + 8 + 8 * (size_t)keys;
    for (size_t i = width; i < (size_t)keys * width; i++) rows[i] ^= rows[i - width];
    return S4D_OK;
}

static s4d_status decode_page(s4d_file *f, page *p) {
    if (p->rows) return S4D_OK;
    const section *s = &f->sections[p->section];
    uint32_t n = s->count, blocks = (n + BLOCK - 1) / BLOCK, entries = MOST_ENTRIES;
    uint8_t *bytes;
    s4d_status status = body(f, p->section, &bytes);
    if (status != S4D_OK) return status;
    if (s->other != NO_PALETTE) {
        status = decode_palette(f, s->other);
        entries = f->sections[s->other].count;
    }
    p->rows = malloc(n * sizeof *p->rows);
    p->visible = malloc(n * sizeof *p->visible);
    if (status == S4D_OK && (!p->rows || !p->visible)) status = S4D_MEMORY;
    const uint8_t *planes = bytes + blocks * BLOCK_BYTES;
    for (uint32_t k = 0; k < blocks && status == S4D_OK; k++) {
        double h[BLOCK_NUMBERS];
        for (int i = 0; i < BLOCK_NUMBERS; i++) {
            int log_range = i == 10 || i == 11 || (i >= 14 && i <= 17);
            h[i] = f32_at(bytes + k * BLOCK_BYTES + 4 * i);
            if (!finite_number(h[i]) || (log_range && fabs(h[i]) > MOST_LOG)) status = S4D_DAMAGED;
        }
        for (uint32_t i = BLOCK * k; i < n && i < BLOCK * (k + 1) && status == S4D_OK; i++) {
            uint32_t w[WORDS] = {0};
            for (uint32_t b = 0; b < 4 * WORDS; b++) w[b / 4] |= (uint32_t)planes[(size_t)b * n + i] << 8 * (b % 4);
            decode_record(w, h, s->from, s->to, &p->rows[i]);
            if (s->other != NO_PALETTE && p->rows[i].entry >= entries) status = S4D_DAMAGED;
        }
    }
    free(bytes);
    if (status == S4D_OK && p->mask_section != NO_PALETTE) status = decode_masks(f, p);
    if (status == S4D_OK && p->label_section != NO_PALETTE) {
        status = body(f, p->label_section, &p->labels);
        for (uint32_t i = 0; status == S4D_OK && i < n; i++)
            if (p->labels[i] != 255 && p->labels[i] >= f->info.labels) status = S4D_DAMAGED;
    }
    if (status == S4D_OK && p->feature_section != NO_PALETTE) status = body(f, p->feature_section, &p->features);
    if (status != S4D_OK) forget(p);
    return status;
}

static double opacity_at(const record *r, double t) {
    double delta = t - r->center, late = fabs(delta) - r->half_width;
    if (!(late > 0)) return r->opacity;
    late /= r->softness;
    return r->opacity * exp(-0.5 * late * late);
}

/* Mean and rotation at t; 0: not finite, which is not rendered. */
static int pose_at(const record *r, double t, double *mean, double *q) {
    double d = t - r->center, a = r->turn[0], b = r->turn[1], c = r->turn[2];
    const float *s = r->quat;
    for (int k = 0; k < 3; k++) mean[k] = r->mean[k] + (double)r->velocity[k] * d;
    q[0] = s[0] + 0.5 * d * (-a * s[1] - b * s[2] - c * s[3]);
    q[1] = s[1] + 0.5 * d * (a * s[0] + b * s[3] - c * s[2]);
    q[2] = s[2] + 0.5 * d * (b * s[0] + c * s[1] - a * s[3]);
    q[3] = s[3] + 0.5 * d * (c * s[0] + a * s[2] - b * s[1]);
    normalize(q);
    double sum = mean[0] + mean[1] + mean[2] + q[0] + q[1] + q[2] + q[3];
    return finite_number(sum);
}

/* The masks of key times l (the last one up to t) and r (the first one from t on). */
static void keys_at(const section *s, const uint8_t *masks, double t, const uint8_t **l, const uint8_t **r) {
    uint32_t keys = key_times(s), width = (s->count + 7) / 8, from = 0, to = keys;
    const uint8_t *rows = masks + 8 + 8 * (size_t)keys;
    /* `from`: how many are at most t. */
    while (from < to) {
        uint32_t middle = from + (to - from) / 2;
        if (f64_at(masks + 8 + 8 * (size_t)middle) <= t) from = middle + 1;
        else to = middle;
    }
    uint32_t left = from ? from - 1 : 0, right = left;
    if (f64_at(masks + 8 + 8 * (size_t)left) < t && left + 1 < keys) right = left + 1;
    *l = rows + (size_t)left * width;
    *r = rows + (size_t)right * width;
}

static void show(const s4d_file *f, page *p, double t) {
    const uint8_t *l = NULL, *r = NULL;
    if (p->masks) keys_at(&f->sections[p->mask_section], p->masks, t, &l, &r);
    p->shown = 0;
    for (uint32_t i = 0; i < p->count; i++) {
        double mean[3], q[4];
        if (l && !((l[i / 8] | r[i / 8]) >> i % 8 & 1)) continue;
        /* Half a step of single precision below 1/255: an opacity of exactly that is rendered. */
        if (opacity_at(&p->rows[i], t) < VISIBLE * (1 - 1e-7) || !pose_at(&p->rows[i], t, mean, q)) continue;
        p->visible[p->shown++] = (uint16_t)i;
    }
}

s4d_status s4d_seek(s4d_file *f, double t) {
    if (!f || !finite_number(t)) return S4D_ARGUMENT;
    if (t < f->info.clip[0]) t = f->info.clip[0];
    if (t > f->info.clip[1]) t = f->info.clip[1];
    s4d_status status = S4D_OK;
    f->time = t;
    f->rendered = 0;
    for (uint32_t i = 0; i < f->page_count; i++) {
        page *p = &f->pages[i];
        const section *s = &f->sections[p->section];
        p->shown = 0;
        if (!(s->from <= t && t < s->to)) {
            forget(p);
            continue;
        }
        if (status != S4D_OK) continue;
        status = decode_page(f, p);
        if (status != S4D_OK) continue;
        show(f, p, t);
        f->rendered += p->shown;
    }
    for (uint32_t i = 0; status != S4D_OK && i < f->page_count; i++) f->pages[i].shown = 0;
    if (status != S4D_OK) f->rendered = 0;
    return status;
}

size_t s4d_count(const s4d_file *f) { return f ? f->rendered : 0; }

double s4d_time(const s4d_file *f) { return f ? f->time : 0; }

static unsigned degree_of(unsigned k) { return k < 4 ? 1 : k < 9 ? 2 : 3; }

static void sh_of(const s4d_file *f, const page *p, uint32_t row, float *out) {
    uint32_t palette = f->sections[p->section].other;
    memset(out, 0, 3 * S4D_SH_REST * sizeof *out);
    if (palette == NO_PALETTE) return;
    const section *s = &f->sections[palette];
    const uint8_t *bytes = f->palettes[palette], *codes_of = bytes + 12 + p->rows[row].entry;
    for (unsigned k = 1; k < (s->number + 1) * (s->number + 1); k++) {
        double range = f32_at(bytes + 4 * (degree_of(k) - 1));
        for (unsigned c = 0; c < 3; c++)
            out[3 * (k - 1) + c] = (float)(range * ((int)codes_of[(size_t)(3 * (k - 1) + c) * s->count] - 128) / 127);
    }
}

s4d_status s4d_read(const s4d_file *f, const s4d_arrays *a) {
    if (!f || !a) return S4D_ARGUMENT;
    size_t n = 0;
    for (uint32_t i = 0; i < f->page_count; i++) {
        const page *p = &f->pages[i];
        for (uint32_t j = 0; j < p->shown; j++, n++) {
            uint32_t row = p->visible[j];
            const record *r = &p->rows[row];
            double mean[3], q[4];
            (void)pose_at(r, f->time, mean, q);
            for (unsigned k = 0; k < 3; k++) {
                if (a->position) a->position[3 * n + k] = single(mean[k]);
                if (a->scale) a->scale[3 * n + k] = r->scale[k];
                if (a->base_color) a->base_color[3 * n + k] = r->color[k];
                if (a->velocity) a->velocity[3 * n + k] = r->velocity[k];
            }
            for (unsigned k = 0; a->rotation && k < 4; k++) a->rotation[4 * n + k] = (float)q[k];
            if (a->opacity) a->opacity[n] = (float)opacity_at(r, f->time);
            if (a->sh) sh_of(f, p, row, a->sh + 3 * S4D_SH_REST * n);
            if (a->page) a->page[n] = p->section;
            if (a->row) a->row[n] = row;
            if (a->label) a->label[n] = p->labels ? p->labels[row] : 255;
            for (unsigned c = 0; a->feature && c < f->info.features; c++) {
                unsigned code = p->features ? p->features[(size_t)c * p->count + row] : 0;
                double low = f->ranges[c][0], high = f->ranges[c][1];
                a->feature[n * f->info.features + c] = code ? single(low + (high - low) * ((code - 1) / 254.0)) : 0;
            }
        }
    }
    return S4D_OK;
}

void s4d_color(const float *base, const float *sh, const float *position, const float *eye, unsigned degree, float *color) {
    double d[3], length = 0, y[S4D_SH_REST];
    for (int k = 0; k < 3; k++) {
        d[k] = (double)position[k] - eye[k];
        length += d[k] * d[k];
    }
    length = sqrt(length);
    for (int k = 0; k < 3; k++) d[k] = length > 0 ? d[k] / length : 0;
    double x = d[0], v = d[1], z = d[2], xx = x * x, vv = v * v, zz = z * z;
    y[0] = -0.4886025119029199 * v;
    y[1] = 0.4886025119029199 * z;
    y[2] = -0.4886025119029199 * x;
    y[3] = 1.0925484305920792 * x * v;
    y[4] = -1.0925484305920792 * v * z;
    y[5] = 0.31539156525252005 * (2 * zz - xx - vv);
    y[6] = -1.0925484305920792 * x * z;
    y[7] = 0.5462742152960396 * (xx - vv);
    y[8] = -0.5900435899266435 * v * (3 * xx - vv);
    y[9] = 2.890611442640554 * x * v * z;
    y[10] = -0.4570457994644658 * v * (4 * zz - xx - vv);
    y[11] = 0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * vv);
    y[12] = -0.4570457994644658 * x * (4 * zz - xx - vv);
    y[13] = 1.445305721320277 * z * (xx - vv);
    y[14] = -0.5900435899266435 * x * (xx - 3 * vv);
    unsigned used = degree == 0 ? 0 : degree == 1 ? 3 : degree == 2 ? 8 : 15;
    for (unsigned c = 0; c < 3; c++) {
        double sum = base[c];
        for (unsigned k = 0; k < used; k++) sum += y[k] * sh[3 * k + c];
        color[c] = sum > 0 ? (float)sum : 0;
    }
}

const char *s4d_label(const s4d_file *f, unsigned label, size_t *size) {
    if (!f || !size || label >= f->info.labels) return NULL;
    text t = {f->labels, f->info.json + f->info.json_size};
    const char *name = NULL;
    (void)sign(&t, '[');
    for (unsigned i = 0; i <= label; i++)
        if ((i > 0 && !sign(&t, ',')) || !string(&t, &name, size)) return NULL;
    return name;
}

const void *s4d_poster(const s4d_file *f, size_t *size) {
    for (uint32_t i = 0; f && size && i < f->section_count; i++) {
        const section *s = &f->sections[i];
        if (!is(s, "POST")) continue;
        int there = s->codec == CODEC_RAW && s->offset <= f->size && s->stored <= f->size - s->offset;
        if (!there || crc32_of(f->bytes + s->offset, s->stored) != s->crc) return NULL;
        *size = s->stored;
        return f->bytes + s->offset;
    }
    return NULL;
}

s4d_status s4d_verify(s4d_file *f) {
    if (!f) return S4D_ARGUMENT;
    for (uint32_t i = 0; i < f->section_count; i++) {
        const section *s = &f->sections[i];
        if (s->offset > f->size || s->stored > f->size - s->offset) return S4D_SHORT;
        s4d_status status = S4D_OK;
        if (is(s, "PALT")) status = decode_palette(f, i);
        if (is(s, "POST") || is(s, "PROV") || is(s, "SOUN")) {
            uint8_t *bytes;
            status = body(f, i, &bytes);
            free(bytes);
        }
        if (status != S4D_OK) return status;
    }
    for (uint32_t i = 0; i < f->page_count; i++) {
        page *p = &f->pages[i];
        int needed = p->rows != NULL;
        s4d_status status = decode_page(f, p);
        if (status != S4D_OK) return status;
        if (!needed) forget(p);
    }
    return S4D_OK;
}
