use super::*;
use crate::format::mutate::mutants;
use crate::math::Rng;

fn file(header: &str, data: &[u8]) -> Vec<u8> {
    let mut out = (header.len() as u64).to_le_bytes().to_vec();
    out.extend(header.bytes());
    out.extend(data);
    out
}

fn sample() -> Vec<u8> {
    let rng = Rng::new(1, "tensors", 0);
    // Arbitrary bits: NaN payloads and subnormals must survive.
    let f32s: Vec<f32> = (0..12).map(|i| f32::from_bits(rng.bits(i) as u32)).collect();
    let f64s: Vec<f64> = (0..5).map(|i| f64::from_bits(rng.bits(i + 50))).collect();
    let u32s: Vec<u32> = (0..3).map(|i| rng.bits(i + 80) as u32).collect();
    let u64s = [u64::MAX, 0, 1 << 63];
    let tensors = [
        Tensor::f32("layers.0.means", &[4, 3], &f32s),
        Tensor::f64("moments \"quoted\" é", &[5], &f64s),
        Tensor::u32("parents", &[3, 1], &u32s),
        Tensor::u64("counter", &[3], &u64s),
        Tensor::i64("signed", &[], &[-5]),
        Tensor::f32("none", &[0, 3], &[]),
    ];
    let metadata = [("spec", "{\"version\": 1}"), ("a", "b")].map(|(k, v)| (k.to_owned(), v.to_owned()));
    let mut out = Vec::new();
    write(&tensors, &metadata.into(), &mut out).unwrap();
    let read = SafeTensors::read(&out).unwrap();
    assert_eq!(read.tensors().len(), tensors.len());
    for t in &tensors {
        let got = read.tensor(t.name()).unwrap();
        assert_eq!(got, t);
        let begin = got.bytes().as_ptr() as usize - out.as_ptr() as usize;
        assert_eq!(begin % got.dtype().size(), 0, "{} is aligned in the file", t.name());
    }
    let bits = |v: Vec<f32>| v.into_iter().map(f32::to_bits).collect::<Vec<_>>();
    assert_eq!(bits(read.tensor("layers.0.means").unwrap().as_f32().unwrap()), bits(f32s));
    assert_eq!(read.tensor("parents").unwrap().as_u32().unwrap(), u32s);
    assert_eq!(read.tensor("counter").unwrap().as_u64().unwrap(), u64s);
    assert_eq!(read.tensor("signed").unwrap().as_i64().unwrap(), [-5]);
    assert_eq!(read.metadata()["spec"], "{\"version\": 1}");
    out
}

#[test]
fn every_type_round_trips_bit_for_bit() {
    assert_eq!(sample(), sample(), "the same content must give the same bytes");
}

#[test]
fn a_foreign_file_in_another_order_is_read() {
    let header = r#"{"b":{"shape":[2],"data_offsets":[4,8],"dtype":"F16"},
        "a":{"dtype":"BF16","shape":[1,2],"data_offsets":[0,4]},"__metadata__":{"format":"pt"}}   "#;
    let bytes = file(header, &[0x80, 0x3F, 0x80, 0xBF, 0x00, 0x3C, 0x00, 0xC0]);
    let read = SafeTensors::read(&bytes).unwrap();
    assert_eq!(read.tensor("a").unwrap().bytes(), [0x80, 0x3F, 0x80, 0xBF]);
    assert_eq!(read.tensor("b").unwrap().bytes(), [0x00, 0x3C, 0x00, 0xC0]);
    assert_eq!(read.tensor("a").unwrap().shape(), [1, 2]);
    let wrong = read.tensor("b").unwrap().as_u32().unwrap_err().to_string();
    assert!(wrong.contains("`b`") && wrong.contains("F16"), "{wrong}");
    assert!(read.tensor("c").unwrap_err().to_string().contains("`c`"));
}

#[test]
fn inconsistent_arrays_are_errors_that_name_the_array() {
    let one = |body: &str| file(&format!("{{\"a\":{body}}}"), &[0; 8]);
    let cases = [
        (vec![1, 2, 3], "shorter"),
        (u64::MAX.to_le_bytes().to_vec(), "claims"),
        (file("{\"a\":", &[]), "header cannot be read"),
        (file("[]", &[]), "header cannot be read"),
        (file("{}", &[0]), "end at byte 0"),
        (one(r#"{"dtype":"F32","shape":[3],"data_offsets":[0,8]}"#), "`a` of shape [3]"),
        (one(r#"{"dtype":"F32","shape":[2],"data_offsets":[0,9]}"#), "`a` claims bytes 0..9"),
        (one(r#"{"dtype":"F32","shape":[2],"data_offsets":[8,0]}"#), "`a` begins at byte 8"),
        (one(r#"{"dtype":"F32","shape":[1],"data_offsets":[4,8]}"#), "`a` begins at byte 4"),
        (one(r#"{"dtype":"F32","shape":[1],"data_offsets":[0,4]}"#), "end at byte 4"),
        (one(r#"{"dtype":"F32","shape":[-2],"data_offsets":[0,8]}"#), "cannot be read"),
        (one(r#"{"dtype":"F4","shape":[2],"data_offsets":[0,8]}"#), "`F4`"),
        (one(r#"{"dtype":"U8","shape":[4294967296,4294967296],"data_offsets":[0,8]}"#), "`a` of shape"),
        (one(r#"{"dtype":"F64","shape":[2305843009213693953],"data_offsets":[0,8]}"#), "`a` of shape"),
        (
            file(
                r#"{"a":{"dtype":"U8","shape":[1],"data_offsets":[0,1]},
                    "a":{"dtype":"U8","shape":[1],"data_offsets":[0,1]}}"#,
                &[0],
            ),
            "`a` is a duplicate",
        ),
        (
            file(
                r#"{"a":{"dtype":"U8","shape":[2],"data_offsets":[0,2]},
                    "b":{"dtype":"U8","shape":[2],"data_offsets":[1,3]}}"#,
                &[0; 3],
            ),
            "`b` begins at byte 1",
        ),
        (file(&format!("{{\"a\":{}1{}}}", "[".repeat(5000), "]".repeat(5000)), &[]), "header cannot be read"),
    ];
    for (bytes, needle) in cases {
        let error = SafeTensors::read(&bytes).unwrap_err().to_string();
        assert!(error.contains(needle), "`{error}` should say `{needle}`");
    }
}

#[test]
fn mutants_are_read_or_refused() {
    let read = mutants(&sample(), 1000, "safetensors").filter(|m| SafeTensors::read(m).is_ok()).count();
    assert!(0 < read && read < 1000, "{read} of 1000 mutants were readable");
}

/// One changed bit anywhere: the file is refused, or its content is unchanged.
#[test]
fn a_flipped_bit_is_found_by_the_checksums() {
    let whole = sample();
    let read = SafeTensors::read(&whole).unwrap();
    assert!(!read.metadata().contains_key(CHECKSUMS), "what is checked is not told");
    let mut refused = 0;
    for at in 0..whole.len() {
        let mut flipped = whole.clone();
        flipped[at] ^= 1 << (at % 8);
        match SafeTensors::read(&flipped) {
            // In the key of the checksums: then there are none.
            Ok(same) if same.metadata().len() > read.metadata().len() => {
                assert!(same.tensors().eq(read.tensors()), "byte {at}");
            }
            Ok(same) => assert_eq!(same, read, "byte {at}"),
            Err(error) => refused += usize::from(error.to_string().contains("checksum is another")),
        }
    }
    let numbers = read.tensors().map(|t| t.bytes().len()).sum::<usize>();
    assert!(refused >= numbers, "{refused} of {numbers} bytes of numbers");
}
