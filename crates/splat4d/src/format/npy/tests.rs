use super::*;
use crate::format::mutate::mutants;

fn file(dict: &str, body: &[u8]) -> Vec<u8> {
    let mut out = b"\x93NUMPY\x01\x00".to_vec();
    out.extend((dict.len() as u16).to_le_bytes());
    out.extend(dict.bytes());
    out.extend(body);
    out
}

fn saved(shape: &[usize]) -> (Vec<f32>, Vec<u8>) {
    let data: Vec<f32> = (0..shape.iter().product()).map(|i| i as f32 * 0.37 - 2.0).collect();
    let mut bytes = Vec::new();
    write_f32(shape, &data, &mut bytes).unwrap();
    (data, bytes)
}

#[test]
fn round_trip_in_every_dimension() {
    for shape in [&[][..], &[0], &[7], &[4, 5], &[3, 4, 3], &[2, 0, 3]] {
        let (data, bytes) = saved(shape);
        assert_eq!((bytes.len() - 4 * data.len()) % ALIGN, 0);
        assert_eq!(Npy::read(&bytes).unwrap(), Npy { shape: shape.to_vec(), values: Values::F32(data) });
    }
}

#[test]
fn foreign_types_orders_and_versions() {
    let big = file(
        "{'shape': (2,), 'fortran_order': False, 'descr': '>f8'}\n",
        &[0x3F, 0xF8, 0, 0, 0, 0, 0, 0, 0xC0, 0, 0, 0, 0, 0, 0, 0],
    );
    assert_eq!(Npy::read(&big).unwrap().values, Values::F64(vec![1.5, -2.0]));
    let half = file("{\"descr\":\"<f2\",\"fortran_order\":False,\"shape\":()}", &[0, 0x3C]);
    assert_eq!(Npy::read(&half).unwrap(), Npy { shape: vec![], values: Values::F32(vec![1.0]) });
    let columns = file("{'descr': '|u1', 'fortran_order': True, 'shape': (2, 3), }", &[1, 4, 2, 5, 3, 6]);
    assert_eq!(Npy::read(&columns).unwrap().values, Values::U8(vec![1, 2, 3, 4, 5, 6]));
    let ints = file("{'descr': '<i2', 'fortran_order': False, 'shape': (2L,)}", &[0xFF, 0xFF, 3, 0, 9, 9]);
    assert_eq!(Npy::read(&ints).unwrap().to_f64(), [-1.0, 3.0]);
    let mut second = b"\x93NUMPY\x02\x00".to_vec();
    let dict = "{'descr': '<f4', 'fortran_order': False, 'shape': (1,)}";
    second.extend((dict.len() as u32).to_le_bytes());
    second.extend(dict.bytes());
    second.extend(2.5f32.to_le_bytes());
    assert_eq!(Npy::read(&second).unwrap().to_f32(), [2.5]);
}

#[test]
fn inconsistent_headers_are_errors_with_a_reason() {
    let cases = [
        (b"PK\x03\x04 something else".to_vec(), "not a NumPy array"),
        (file("{'descr': '<f4', 'fortran_order': False, 'shape': (1152921504606846976, 8)}", &[]), "cut short"),
        (file("{'descr': '<f4', 'fortran_order': False, 'shape': (4611686018427387904,)}", &[]), "cut short"),
        (file("{'descr': '<f4', 'fortran_order': False, 'shape': (3,)}", &[0; 11]), "cut short"),
        (file("{'descr': '<f4', 'fortran_order': False, 'shape': (-3,)}", &[0; 11]), "shape"),
        (file("{'descr': '|O', 'fortran_order': False, 'shape': (3,)}", &[0; 11]), "plain numbers"),
        (file("{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (1,)}", &[0; 4]), "structured"),
        (file("{'descr': '<f4', 'shape': (1,)}", &[0; 4]), "lacks"),
        (b"\x93NUMPY\x02\x00\xFF\xFF\xFF\xFF{}".to_vec(), "header claims"),
        (b"\x93NUMPY\x01\x00\x30\x00{'descr': '<f4'".to_vec(), "header claims"),
    ];
    for (bytes, needle) in cases {
        let error = Npy::read(&bytes).unwrap_err().to_string();
        assert!(error.contains(needle), "`{error}` should say `{needle}`");
    }
}

#[test]
fn mutants_are_read_or_refused() {
    let (_, bytes) = saved(&[6, 7]);
    let fortran = file("{'descr': '<i2', 'fortran_order': True, 'shape': (2, 3, 4)}", &[7; 48]);
    let read = mutants(&bytes, 600, "npy").chain(mutants(&fortran, 400, "npy-f")).filter_map(|m| Npy::read(&m).ok());
    let read = read.inspect(|a| assert_eq!(a.len(), a.shape.iter().product::<usize>())).count();
    assert!(0 < read && read < 1000, "{read} of 1000 mutants were readable");
}

#[test]
fn arrays_of_an_archive_are_found() {
    let mut body = Vec::new();
    write_f32(&[2, 3], &[0.0, 0.5, 1.0, 1.5, 2.0, 2.5], &mut body).unwrap();
    let size = (body.len() as u32).to_le_bytes();
    let mut zip = b"PK\x03\x04".to_vec();
    zip.extend([0; 22]);
    zip.extend([8, 0, 0, 0]);
    zip.extend(b"data.npy");
    zip.extend(&body);
    let directory = zip.len() as u32;
    zip.extend(b"PK\x01\x02");
    zip.extend([0; 16]);
    zip.extend(size);
    zip.extend(size);
    zip.extend([8, 0]);
    zip.extend([0; 16]);
    zip.extend(b"data.npy");
    zip.extend(b"PK\x05\x06\0\0\0\0\x01\0\x01\0");
    zip.extend((zip.len() as u32 - directory).to_le_bytes());
    zip.extend(directory.to_le_bytes());
    zip.extend([0; 2]);
    assert_eq!(Npy::read_member(&zip, "data").unwrap(), Npy::read(&body).unwrap());
    let error = Npy::read_member(&zip, "other").unwrap_err().to_string();
    assert!(error.contains("`other`") && error.contains("data"), "{error}");
    assert!((0..zip.len() - 2).all(|n| Npy::read_member(&zip[..n], "data").is_err()));
}
