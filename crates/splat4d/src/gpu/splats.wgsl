// Projects and colours a run of one part's rows. Twin of render/project.rs (forward) and render/shade.rs (forward);
// render/project.wgsl and render/shade.wgsl are put in front of this file.
//
// Bindings, group 0: 0 view; 1 piece; the tables as the scene holds them, [row / 16][column][16]: 2 geometry (mean 3,
// covariance 6, opacity 1), 3 table (SH, or colours as they are), 4 ids (rows of the SH table), 5 weights (of blocks of
// SH coefficients); out, one row a splat of all parts: 6 shapes (two vec4: centre, extent; conic, opacity), 7 colors
// (red, green, blue, depth), 8 marks (1: visible). Seven storage buffers.
// A thread owns one row.

const PIECE_DIRECT: u32 = 1u;
const PIECE_IDS: u32 = 2u;
const PIECE_WEIGHTS: u32 = 4u;
// Rows in a block of a table (scene/table.rs).
const TABLE_BLOCK: u32 = 16u;
// Columns of the geometry table (scene/splats.rs).
const GEOMETRY_WIDTH: u32 = 10u;

struct Piece {
    first_row: u32,   // of the part
    rows: u32,
    first_splat: u32, // number of the first row among all parts' splats
    width: u32,       // columns of the colour table
    blocks: u32,      // blocks of SH coefficients
    flags: u32,
    first_id: u32,    // row of the colour table with which the buffer begins
    first_group: u32, // of splats_back.wgsl
    layer_from_world: mat3x3<f32>, // of directions, to the axes of the SH; the identity where they are the world's
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> piece: Piece;
@group(0) @binding(2) var<storage, read> geometry: array<f32>;
@group(0) @binding(3) var<storage, read> table: array<f32>;
@group(0) @binding(4) var<storage, read> ids: array<u32>;
@group(0) @binding(5) var<storage, read> weights: array<f32>;
@group(0) @binding(6) var<storage, read_write> shapes: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> colors: array<vec4<f32>>;
@group(0) @binding(8) var<storage, read_write> marks: array<u32>;

fn table_at(row: u32, column: u32, width: u32) -> u32 {
    return (row / TABLE_BLOCK * width + column) * TABLE_BLOCK + row % TABLE_BLOCK;
}

// Colour of row j seen from the camera.
fn color_of(j: u32, mean: vec3<f32>) -> vec3<f32> {
    var row = j;
    if ((piece.flags & PIECE_IDS) != 0u) {
        row = ids[j];
    }
    row -= piece.first_id;
    if ((piece.flags & PIECE_DIRECT) != 0u) {
        var rgb = vec3<f32>(0.0);
        for (var c = 0u; c < min(piece.width, 3u); c++) {
            rgb[c] = table[table_at(row, c, piece.width)];
        }
        return rgb;
    }
    let block = piece.width / piece.blocks;
    let used = sh_used(block / 3u, view.sh_degree);
    var basis = sh_basis(piece.layer_from_world * normalize(mean - view.camera));
    var rgb = vec3<f32>(0.0);
    for (var b = 0u; b < piece.blocks; b++) {
        var sum = vec3<f32>(0.0);
        for (var k = 0u; k < used; k++) {
            let at = table_at(row, b * block + 3u * k, piece.width);
            sum += basis[k] * vec3<f32>(table[at], table[at + TABLE_BLOCK], table[at + 2u * TABLE_BLOCK]);
        }
        if ((piece.flags & PIECE_WEIGHTS) != 0u) {
            sum *= weights[table_at(j, b, piece.blocks)];
        }
        rgb += sum;
    }
    // NaN shows as black, as on the CPU, whose max drops it.
    rgb = select(vec3<f32>(0.0), rgb, vec3<bool>(finite(rgb.x), finite(rgb.y), finite(rgb.z)));
    return max(rgb + SH_COLOR_OFFSET, vec3<f32>(0.0));
}

@compute @workgroup_size(256)
fn splats(@builtin(global_invocation_id) at: vec3<u32>) {
    if (at.x >= piece.rows) {
        return;
    }
    let j = piece.first_row + at.x;
    let splat = piece.first_splat + at.x;
    let g = table_at(j, 0u, GEOMETRY_WIDTH);
    let mean = vec3<f32>(geometry[g], geometry[g + 16u], geometry[g + 32u]);
    let cov = Cov(geometry[g + 48u], geometry[g + 64u], geometry[g + 80u], geometry[g + 96u], geometry[g + 112u],
        geometry[g + 128u]);
    let opacity = geometry[g + 144u];
    let e = project(view, mean, cov, opacity);
    marks[splat] = e.visible;
    if (e.visible == 0u) {
        return;
    }
    shapes[2u * splat] = vec4<f32>(e.center, e.extent);
    shapes[2u * splat + 1u] = vec4<f32>(e.conic, opacity * e.rho);
    colors[splat] = vec4<f32>(color_of(j, mean), e.depth);
}
