//! ASTM E57 by the crate `e57`: all scans of a file, each with its pose.

use super::surface::{Sink, Surface};
use e57::{CartesianCoordinate, E57Reader};
use splat4d::{Error, Result};
use std::io::Cursor;

/// Reads the points of all scans. Intensities are not taken for colours.
///
/// Errors: damage; more points than the bytes can hold; no scan with positions.
pub(super) fn read(bytes: &[u8]) -> Result<Surface> {
    let damaged = |e: e57::Error| {
        Error::input(format!("invalid E57 file: {e}"))
            .remedy("Copy or export the file again, or save the scan as .las or .ply")
    };
    let mut reader = E57Reader::new(Cursor::new(bytes)).map_err(damaged)?;
    let scans: Vec<_> = reader.pointclouds().into_iter().filter(|s| s.has_cartesian() || s.has_spherical()).collect();
    // A point takes a bit at least: a false number cannot keep us here.
    let claimed = scans.iter().try_fold(0u64, |sum, s| sum.checked_add(s.records));
    let Some(count) = claimed.filter(|n| n / 8 <= bytes.len() as u64) else {
        return Err(Error::input(format!("the E57 file claims more points than its {} bytes can hold", bytes.len()))
            .remedy("Copy or export the file again"));
    };
    if scans.is_empty() {
        return Err(Error::input("the E57 file has no scan with positions")
            .remedy("Export the scan with Cartesian or spherical coordinates"));
    }
    let colored = scans.iter().all(e57::PointCloud::has_color);
    let mut sink = Sink::new(count, colored);
    for (i, scan) in scans.iter().enumerate() {
        let place = |e| damaged(e).at(format!("scan {i}"));
        let mut points = reader.pointcloud_simple(scan).map_err(place)?;
        points.intensity_to_color(false);
        for point in points {
            let point = point.map_err(place)?;
            if let CartesianCoordinate::Valid { x, y, z } = point.cartesian {
                sink.push([x, y, z], point.color.map_or([0.5; 3], |c| [c.red, c.green, c.blue]));
            }
        }
    }
    Ok(sink.finish())
}

/// A file of one scan, for tests.
#[cfg(test)]
pub(super) fn write(points: &[[f64; 3]]) -> Vec<u8> {
    use e57::{E57Writer, Record, RecordValue};
    let mut out = Cursor::new(Vec::new());
    let mut writer = E57Writer::new(&mut out, "file").unwrap();
    let prototype = vec![
        Record::CARTESIAN_X_F64,
        Record::CARTESIAN_Y_F64,
        Record::CARTESIAN_Z_F64,
        Record::COLOR_RED_U8,
        Record::COLOR_GREEN_U8,
        Record::COLOR_BLUE_U8,
    ];
    let mut scan = writer.add_pointcloud("scan", prototype).unwrap();
    for p in points {
        let mut row: Vec<RecordValue> = p.iter().map(|v| RecordValue::Double(*v)).collect();
        row.extend([255, 0, 51].map(RecordValue::Integer));
        scan.add_point(row).unwrap();
    }
    scan.finalize().unwrap();
    writer.finalize().unwrap();
    drop(writer);
    out.into_inner()
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat4d::math::Rng;

    #[test]
    fn scans_round_trip_and_damage_is_an_error() {
        let points = [[1.5, -2.0, 3e6], [0.25, 0.0, -1.0]];
        let file = write(&points);
        let read = read(&file).unwrap();
        assert_eq!((&read.points[..], read.colors[1]), (&points[..], [1.0, 0.0, 0.2]));
        let rng = Rng::new(3, "damage", 0);
        for k in 0..300u64 {
            let mut bytes = file.clone();
            let at = rng.below(2 * k, bytes.len());
            bytes[at] ^= 1 << rng.below(2 * k + 1, 8);
            let _ = super::read(&bytes);
            let _ = super::read(&file[..at]);
        }
        assert!(super::read(&file[..40]).unwrap_err().to_string().contains("E57"));
    }
}
