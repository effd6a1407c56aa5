/* libs4d: reads `.s4d` playback files, dynamic scenes of 3D Gaussians. C99, no dependencies but libc and libm.
 *
 * The format is specified in docs/format.md of the splat4d repository. One file, s4d.c, is the whole library.
 * Licence: MIT OR Apache-2.0, as splat4d.
 *
 *     s4d_file *file;
 *     s4d_status status = s4d_open(bytes, size, &file);
 *     if (status != S4D_OK) { puts(s4d_text(status)); return 1; }
 *     status = s4d_seek(file, 0.5);
 *     size_t n = s4d_count(file);
 *     float *position = malloc(n * 3 * sizeof(float)), *opacity = malloc(n * sizeof(float));
 *     s4d_arrays arrays = {0};
 *     arrays.position = position;
 *     arrays.opacity = opacity;
 *     s4d_read(file, &arrays);
 *     s4d_close(file);
 *
 * Conventions: little or big endian machines; lengths are scene units, times seconds; the world has the capture's axes,
 * s4d_info.up points up; a camera looks along +z with x right and y down; quaternions are w x y z; colours are display (sRGB)
 * values, as the training images had them.
 *
 * Safety: every length, place and number of a file is checked before it is used. Memory is bounded by the file's size (see
 * S4D_MOST_GROWTH). No input makes a function read outside of `bytes`, loop without end or abort.
 *
 * Threads: functions share nothing but the file. Use a file from one thread at a time.
 */
#ifndef S4D_H
#define S4D_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* The newest version of the format that this library knows. Files of a larger minor version are read. */
#define S4D_MAJOR 1
#define S4D_MINOR 2

/* Coefficients of the spherical harmonics above degree 0, per channel, that `s4d_arrays.sh` holds: those of degree 3. */
#define S4D_SH_REST 15

/* A file that unpacks to more than this many times its size, and S4D_SMALL bytes more, is refused. */
#define S4D_MOST_GROWTH 64
#define S4D_SMALL ((uint64_t)64 << 20)

/* What a function returns. Numbers do not change between versions. */
typedef enum s4d_status {
    S4D_OK = 0,
    /* An argument is NULL where it must not be, or a time is not finite. */
    S4D_ARGUMENT = 1,
    /* There is no memory. */
    S4D_MEMORY = 2,
    /* The bytes do not begin as a playback file. */
    S4D_FOREIGN = 3,
    /* The file has a newer major version, a required section or a codec that this library does not know. */
    S4D_NEWER = 4,
    /* The file ends before its header or index does, or a section that is needed is beyond the end. */
    S4D_SHORT = 5,
    /* A checksum is wrong, or numbers of the file contradict each other. */
    S4D_DAMAGED = 6,
    /* The file unpacks to more than it may. */
    S4D_TOO_LARGE = 7
} s4d_status;

/* An open file. */
typedef struct s4d_file s4d_file;

/* About the scene. Pointers live as long as the file is open. */
typedef struct s4d_info {
    /* Version of the file's format. 2.0: a capture that is still training; more will be appended. */
    unsigned major, minor;
    /* First and last second. Times outside are clamped. */
    double clip[2];
    /* Frames per second of the capture. */
    double fps;
    /* Unit vector that points up. */
    double up[3];
    /* Colour behind everything. */
    double background[3];
    /* Metres per scene unit; 0: unknown. */
    double unit;
    /* World coordinates of the scene's origin; zero unless the capture was far from its origin. */
    double offset[3];
    /* Degree of the spherical harmonics, 0 to 3. */
    unsigned sh_degree;
    /* Records in all pages: an upper bound of the Gaussians at any time. */
    uint64_t records;
    /* Names of labels, and feature channels; 0: none. */
    unsigned labels, features;
    /* The whole JSON of the index, which has cameras, a camera path, title and more. Not terminated by a zero. */
    const char *json;
    size_t json_size;
} s4d_info;

/* Where `s4d_read` writes. Each pointer may be NULL: that array is not written. n is `s4d_count`. */
typedef struct s4d_arrays {
    /* 3n: means, scene units. */
    float *position;
    /* 4n: unit quaternions w x y z. */
    float *rotation;
    /* 3n: standard deviations along the Gaussian's axes, scene units. */
    float *scale;
    /* n: 0 to 1, temporal opacity applied. */
    float *opacity;
    /* 3n: 1/2 + Y00 * (SH coefficient 0), neither clamped nor seen from anywhere. */
    float *base_color;
    /* 3 * S4D_SH_REST * n: coefficient k = 1 to 15 of channel c of Gaussian i at (i * S4D_SH_REST + k - 1) * 3 + c.
     * Coefficients that the file does not have are 0. */
    float *sh;
    /* 3n: scene units per second. */
    float *velocity;
    /* n each: the page (its place in the table of sections) and the Gaussian in it. Both together name a record. */
    uint32_t *page;
    uint32_t *row;
    /* n: number of the label's name, or 255: none. */
    uint8_t *label;
    /* info.features * n: feature channels; 0 in all: none. */
    float *feature;
} s4d_arrays;

/* An entry of the table of sections. */
typedef struct s4d_section {
    /* Four characters: PAGE, PALT, MASK, LABL, FEAT, POST, PROV, SOUN, or a kind that is newer. */
    char kind[4];
    /* Place and size in the file. */
    uint64_t offset;
    uint32_t stored;
    /* Size when decoded. */
    uint32_t size;
    /* Tier of a page (0: the most important), degree of a palette. */
    uint32_t number;
    /* Gaussians of a page, entries of a palette. */
    uint32_t count;
    /* A page is rendered for from <= t < to. Masks: first and last key time. */
    double from, to;
} s4d_section;

/* Words for a status, in English; never NULL. */
const char *s4d_text(s4d_status status);

/* Opens a file that is in memory. `bytes` must stay as they are until `s4d_close`. Checks header, index and table; pages are
 * checked when they are needed, or all at once by `s4d_verify`. The file may be cut short: times whose pages are there can be
 * rendered. After an error `*file` is NULL. */
s4d_status s4d_open(const void *bytes, size_t size, s4d_file **file);

/* Frees the file. NULL is allowed. */
void s4d_close(s4d_file *file);

/* About the scene. */
const s4d_info *s4d_get_info(const s4d_file *file);

/* The table of sections. `s4d_get_section` returns S4D_ARGUMENT beyond the end. */
size_t s4d_sections(const s4d_file *file);
s4d_status s4d_get_section(const s4d_file *file, size_t i, s4d_section *section);

/* Decodes all sections once: what a reader of a whole file has to refuse is refused. A file that is cut short is S4D_SHORT. */
s4d_status s4d_verify(s4d_file *file);

/* Decodes what is rendered at a time (s), which is clamped to the clip. Pages that two times share are decoded once; those
 * that only the earlier time needed are freed. After an error nothing is rendered, and `s4d_count` is 0. */
s4d_status s4d_seek(s4d_file *file, double time);

/* Gaussians that are rendered at the time of the last `s4d_seek`: those whose opacity is at least 1/255 and that masks admit. */
size_t s4d_count(const s4d_file *file);

/* The time of the last `s4d_seek`, clamped. */
double s4d_time(const s4d_file *file);

/* Writes the arrays of that time: pages in the order of the table, Gaussians in the order of their page. */
s4d_status s4d_read(const s4d_file *file, const s4d_arrays *arrays);

/* Colour of a Gaussian seen from `eye`, at least 0 and not limited above: `base_color` 3, `sh` 3 * S4D_SH_REST and `position`
 * 3 floats as `s4d_read` wrote them; `degree` is that of the file, or less. */
void s4d_color(const float *base_color, const float *sh, const float *position, const float *eye, unsigned degree, float *color);

/* The name of a label, UTF-8 with JSON's escapes as the file has them and without a zero at the end; NULL: there is none. */
const char *s4d_label(const s4d_file *file, unsigned label, size_t *size);

/* The poster, a JPEG or PNG image; NULL: there is none, or it is damaged. */
const void *s4d_poster(const s4d_file *file, size_t *size);

#ifdef __cplusplus
}
#endif
#endif
