// Writes a row's gradients: the step's first view overwrites, the others add. After learnt.wgsl.
//
// No bindings and no entry point, but for `query` and `d_params`, which the including shader binds.

fn put(row: u32, column: u32, d: f32) {
    let i = at(row, column, query.width);
    if ((query.flags & QUERY_FIRST) != 0u) {
        d_params[i] = d;
    } else {
        d_params[i] += d;
    }
}

fn put_three(row: u32, column: u32, d: vec3<f32>) {
    put(row, column, d.x);
    put(row, column + 1u, d.y);
    put(row, column + 2u, d.z);
}

fn put_four(row: u32, column: u32, d: vec4<f32>) {
    put_three(row, column, d.xyz);
    put(row, column + 3u, d.w);
}
