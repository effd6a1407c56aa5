/* A program around libs4d, for tests and as an example.
 *
 *     s4d_tool verify FILE                  exit code 2 if a reader has to refuse the file
 *     s4d_tool dump FILE EX EY EZ TIME...   what is rendered, a line per Gaussian, colours as seen from E
 *     s4d_tool mutate FILE COUNT SEED       reads COUNT damaged copies of the file; ends without output if all is well
 */
#include "s4d.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static void *load(const char *path, size_t *size) {
    FILE *in = fopen(path, "rb");
    if (!in) return NULL;
    unsigned char *bytes = NULL;
    size_t used = 0, room = 0;
    for (;;) {
        if (used == room) {
            room = room ? 2 * room : 1 << 16;
            unsigned char *more = realloc(bytes, room);
            if (!more) break;
            bytes = more;
        }
        size_t got = fread(bytes + used, 1, room - used, in);
        used += got;
        if (got == 0) {
            fclose(in);
            *size = used;
            return bytes;
        }
    }
    free(bytes);
    fclose(in);
    return NULL;
}


static s4d_status read_all(s4d_file *file, s4d_arrays *a) {
    size_t n = s4d_count(file) + 1, features = s4d_get_info(file)->features;
    a->position = calloc(3 * n, sizeof(float));
    a->rotation = calloc(4 * n, sizeof(float));
    a->scale = calloc(3 * n, sizeof(float));
    a->opacity = calloc(n, sizeof(float));
    a->base_color = calloc(3 * n, sizeof(float));
    a->sh = calloc(3 * S4D_SH_REST * n, sizeof(float));
    a->velocity = calloc(3 * n, sizeof(float));
    a->feature = calloc((features + 1) * n, sizeof(float));
    a->page = calloc(n, sizeof(uint32_t));
    a->row = calloc(n, sizeof(uint32_t));
    a->label = calloc(n, 1);
    int there = a->position && a->rotation && a->scale && a->opacity && a->base_color && a->sh && a->velocity && a->feature &&
                a->page && a->row && a->label;
    return there ? s4d_read(file, a) : S4D_MEMORY;
}

static void free_all(s4d_arrays *a) {
    free(a->position);
    free(a->rotation);
    free(a->scale);
    free(a->opacity);
    free(a->base_color);
    free(a->sh);
    free(a->velocity);
    free(a->feature);
    free(a->page);
    free(a->row);
    free(a->label);
}

static int ended(s4d_file *file, s4d_status status) {
    s4d_close(file);
    if (status != S4D_OK) fprintf(stderr, "%s\n", s4d_text(status));
    return status == S4D_OK ? 0 : 2;
}

static int verify(const void *bytes, size_t size) {
    s4d_file *file;
    s4d_status status = s4d_open(bytes, size, &file);
    if (status == S4D_OK) status = s4d_verify(file);
    return ended(file, status);
}

static int dump(const void *bytes, size_t size, int count, char **arguments) {
    s4d_file *file;
    s4d_status status = s4d_open(bytes, size, &file);
    float eye[3];
    for (int k = 0; k < 3; k++) eye[k] = (float)atof(arguments[k]);
    if (status == S4D_OK) {
        const s4d_info *info = s4d_get_info(file);
        printf("version %u %u records %llu\n", info->major, info->minor, (unsigned long long)info->records);
    }
    for (int i = 3; i < count && status == S4D_OK; i++) {
        s4d_arrays a;
        status = s4d_seek(file, atof(arguments[i]));
        if (status != S4D_OK) break;
        size_t n = s4d_count(file), features = s4d_get_info(file)->features;
        status = read_all(file, &a);
        printf("time %s %lu\n", arguments[i], (unsigned long)n);
        for (size_t j = 0; j < n && status == S4D_OK; j++) {
            const float *p = a.position + 3 * j, *q = a.rotation + 4 * j, *s = a.scale + 3 * j;
            float color[3];
            s4d_color(a.base_color + 3 * j, a.sh + 3 * S4D_SH_REST * j, p, eye, s4d_get_info(file)->sh_degree, color);
            printf("%u %u %.9g %.9g %.9g %.9g %.9g %.9g %.9g %.9g %.9g %.9g %.9g %.9g %.9g %.9g label %u", a.page[j], a.row[j],
                   p[0], p[1], p[2], q[0], q[1], q[2], q[3], s[0], s[1], s[2], a.opacity[j], color[0], color[1], color[2],
                   a.label[j]);
            for (size_t c = 0; c < features; c++) printf(" %.9g", a.feature[j * features + c]);
            printf("\n");
        }
        free_all(&a);
    }
    return ended(file, status);
}

/* xorshift64*, Vigna 2016. */
static uint64_t random_next(uint64_t *state) {
    *state ^= *state >> 12;
    *state ^= *state << 25;
    *state ^= *state >> 27;
    return *state * 2685821657736338717u;
}

static uint32_t crc_of(const unsigned char *p, size_t size) {
    uint32_t crc = 0xFFFFFFFF;
    for (size_t i = 0; i < size; i++) {
        crc ^= p[i];
        for (int k = 0; k < 8; k++) crc = crc >> 1 ^ (crc & 1 ? 0xEDB88320 : 0);
    }
    return ~crc;
}

static uint32_t get(const unsigned char *p) { return (uint32_t)p[0] | (uint32_t)p[1] << 8 | (uint32_t)p[2] << 16 | (uint32_t)p[3] << 24; }

static void put(unsigned char *p, uint32_t x) {
    for (int k = 0; k < 4; k++) p[k] = (unsigned char)(x >> 8 * k);
}

/* Corrects all checksums that can be found, so that the checks behind them are reached. */
static void reseal(unsigned char *p, size_t size) {
    if (size < 72) return;
    uint64_t index = p[8] == 2 ? get(p + 28) : 64, bytes = get(p + 12);
    if (index < size && bytes <= size - index && bytes >= 8) {
        unsigned char *at = p + index;
        uint64_t json = get(at), table = 8 + json;
        for (uint64_t e = table; e + 64 <= bytes; e += 64) {
            uint64_t offset = get(at + e + 8), stored = get(at + e + 16);
            if (offset <= size && stored <= size - offset) put(at + e + 24, crc_of(p + offset, (size_t)stored));
        }
        put(p + 24, crc_of(at, (size_t)bytes));
    }
    put(p + 60, crc_of(p, 60));
}

static int mutate(const unsigned char *bytes, size_t size, unsigned long count, uint64_t seed) {
    static const unsigned char nasty[8] = {0x00, 0x01, 0x7F, 0x80, 0xFF, 0x20, 0x5B, 0x22};
    uint64_t state = seed * 2 + 1;
    unsigned long accepted = 0;
    if (size == 0) return 2;
    /* Three copies in four are damaged where the start is. */
    size_t index_end = size < 72 ? size : 64 + (size_t)get(bytes + 12);
    if (index_end > size) index_end = size;
    for (unsigned long i = 0; i < count; i++) {
        size_t length = size;
        if (random_next(&state) % 8 == 0) length = 1 + (size_t)(random_next(&state) % size);
        /* An allocation of exactly this size, so that a sanitizer sees a read beyond it. */
        unsigned char *copy = malloc(length);
        if (!copy) return 2;
        memcpy(copy, bytes, length);
        for (unsigned k = (unsigned)(random_next(&state) % 4) + 1; k > 0; k--) {
            size_t within = random_next(&state) % 4 ? index_end : size, at = (size_t)(random_next(&state) % within);
            uint64_t r = random_next(&state);
            if (at < length) copy[at] = (unsigned char)(r % 2 ? nasty[r / 2 % 8] : copy[at] ^ 1 << r / 2 % 8);
        }
        if (random_next(&state) % 4) reseal(copy, length);
        s4d_file *file;
        if (s4d_open(copy, length, &file) == S4D_OK) {
            const double times[3] = {s4d_get_info(file)->clip[0], 0.4, s4d_get_info(file)->clip[1]};
            int good = s4d_verify(file) == S4D_OK;
            for (int k = 0; k < 3; k++) {
                s4d_arrays a;
                size_t unused;
                if (s4d_seek(file, times[k]) != S4D_OK) continue;
                if (read_all(file, &a) == S4D_OK && s4d_count(file) > 0) {
                    const float eye[3] = {0, 0, 0};
                    float color[3];
                    s4d_color(a.base_color, a.sh, a.position, eye, 3, color);
                }
                free_all(&a);
                (void)s4d_label(file, 0, &unused);
                (void)s4d_poster(file, &unused);
            }
            accepted += (unsigned long)good;
        }
        s4d_close(file);
        free(copy);
    }
    printf("%lu of %lu accepted\n", accepted, count);
    return 0;
}

int main(int count, char **arguments) {
    int code = 2;
    size_t size = 0;
    void *bytes = count > 2 ? load(arguments[2], &size) : NULL;
    /* An allocation of the very size, so that a sanitizer sees a read beyond the end. */
    void *exact = bytes ? malloc(size ? size : 1) : NULL;
    if (exact) memcpy(exact, bytes, size);
    if (exact && count == 3 && strcmp(arguments[1], "verify") == 0) {
        code = verify(exact, size);
    } else if (exact && count > 6 && strcmp(arguments[1], "dump") == 0) {
        code = dump(exact, size, count - 3, arguments + 3);
    } else if (exact && count == 5 && strcmp(arguments[1], "mutate") == 0) {
        code = mutate(bytes, size, strtoul(arguments[3], NULL, 10), strtoull(arguments[4], NULL, 10));
    } else {
        fprintf(stderr, "s4d_tool verify FILE | dump FILE EX EY EZ TIME... | mutate FILE COUNT SEED\n");
    }
    free(exact);
    free(bytes);
    return code;
}
