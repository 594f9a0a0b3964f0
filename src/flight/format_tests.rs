use super::*;

const HEADER: &str = "file,stamp_ns,agl_m,gsd_m,yaw_deg,pitch_deg,roll_deg,prior_lat_deg,prior_lon_deg,prior_sigma_m,prior_radius_m,truth_lat_deg,truth_lon_deg,truth_yaw_deg";

/// Opens a flight with these two files.
fn open(toml: &str, csv: &str) -> Result<Flight, FlightError> {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("flight.toml"), toml).expect("flight.toml");
    std::fs::write(folder.path().join("poses.csv"), csv).expect("poses.csv");
    Flight::open(folder.path())
}

/// The error's text, without the folder's changing name.
fn text(result: Result<Flight, FlightError>) -> String {
    result.expect_err("an error").to_string()
}

#[test]
fn all_columns_and_keys_are_read() {
    let toml = "schema = 1\nname = \"n\"\nmap = \"maps/m.tif\"\nnotes = \"x\"\n[camera]\nhfov_deg = 48.0\nmount_yaw_deg = 90.0\n";
    let csv = format!("{HEADER}\na/f.png,-5,120,0.2,-90,1,-2,25,55,,512,25.1,55.1,3\n");
    let flight = open(toml, &csv).expect("a flight");
    assert_eq!(flight.name.as_deref(), Some("n"));
    assert!(flight.map.expect("a map").ends_with("maps/m.tif"));
    assert_eq!((flight.camera.hfov_deg, flight.camera.mount_yaw_deg, flight.camera.mount_roll_deg), (Some(48.0), 90.0, 0.0));
    let row = flight.rows.first().expect("a row");
    assert_eq!((row.file.as_str(), row.stamp_ns), ("a/f.png", -5));
    let pose = &row.pose;
    assert_eq!(
        (pose.agl_m, pose.gsd_m, pose.yaw_deg, pose.pitch_deg, pose.roll_deg),
        (Some(120.0), Some(0.2), Some(-90.0), Some(1.0), Some(-2.0))
    );
    let prior = RowPrior { position: LatLon { lat_deg: 25.0, lon_deg: 55.0 }, spread: Some(Spread::RadiusM(512.0)) };
    assert_eq!(row.prior, Some(prior));
    assert_eq!((row.truth, row.truth_yaw_deg), (Some(LatLon { lat_deg: 25.1, lon_deg: 55.1 }), Some(3.0)));
}

#[test]
fn columns_come_in_any_order_and_unknown_ones_are_warned_about() {
    let flight = open("", "battery, stamp_ns ,file\n12,7,f.png\n").expect("a flight");
    assert_eq!(flight.rows.first().map(|r| (r.file.as_str(), r.stamp_ns)), Some(("f.png", 7)));
    let [warning] = flight.warnings.as_slice() else { panic!("one warning, found {:?}", flight.warnings) };
    assert!(warning.contains("battery"), "{warning}");
}

#[test]
fn empty_means_unknown_never_zero() {
    let flight = open("", &format!("{HEADER}\nf.png,1,,,,,,,,,,,,\n")).expect("a flight");
    let row = flight.rows.first().expect("a row");
    assert_eq!((row.pose, row.prior, row.truth, row.truth_yaw_deg), (Pose::default(), None, None, None));
}

#[test]
fn a_radius_wins_over_a_sigma_and_a_prior_may_lack_both() {
    let csv = format!("{HEADER}\nf.png,1,,,,,,1,2,30,400,,,\nf.png,1,,,,,,1,2,30,,,,\nf.png,1,,,,,,1,2,,,,,\n");
    let rows = open("", &csv).expect("a flight").rows;
    let spreads: Vec<_> = rows.iter().map(|r| r.prior.expect("a prior").spread).collect();
    assert_eq!(spreads, [Some(Spread::RadiusM(400.0)), Some(Spread::SigmaM(30.0)), None]);
}

#[test]
fn bad_cells_name_file_row_line_column_expected_and_found() {
    // A quoted cell over two lines: rows and lines part ways.
    let csv = "file,stamp_ns,note,agl_m\nf.png,1,\"a\nb\",5\ng.png,2,c,high\n";
    let text = text(open("", csv));
    for part in ["poses.csv", "row 2", "line 4", "`agl_m`", "a positive number", "`high`"] {
        assert!(text.contains(part), "`{part}` in: {text}");
    }
}

#[test]
fn what_no_cell_may_hold() {
    let cases = [
        ("agl_m", "0"),
        ("agl_m", "-1"),
        ("gsd_m", "NaN"),
        ("gsd_m", "inf"),
        ("yaw_deg", "361"),
        ("pitch_deg", "181"),
        ("prior_radius_m", "5"),
        ("prior_lat_deg", "91"),
        ("prior_lat_deg", "25"),
        ("truth_lon_deg", "181"),
        ("truth_lon_deg", "55"),
        ("file", "../f.png"),
        ("file", "/f.png"),
        ("file", ""),
        ("stamp_ns", ""),
        ("stamp_ns", "1.5"),
        ("stamp_ns", "99999999999999999999"),
    ];
    for (column, cell) in cases {
        let (mut names, mut cells) = (vec!["file", "stamp_ns"], vec!["f.png", "1"]);
        match names.iter().position(|n| *n == column) {
            Some(i) => cells[i] = cell,
            None => {
                names.push(column);
                cells.push(cell);
            }
        }
        let error = open("", &format!("{}\n{}\n", names.join(","), cells.join(","))).expect_err("refused");
        assert!(matches!(error, FlightError::Cell { row: 1, line: 2, .. }), "{column} = `{cell}`: {error}");
    }
}

#[test]
fn headers_and_records_must_fit() {
    assert!(text(open("", "stamp_ns\n1\n")).contains("`file`"));
    assert!(text(open("", "file\nf.png\n")).contains("`stamp_ns`"));
    assert!(text(open("", "")).contains("an empty file"));
    assert!(text(open("", "file,stamp_ns,agl_m,agl_m\n")).contains("twice"));
    assert!(text(open("", "file,stamp_ns\nf.png,1,2\n")).contains("poses.csv"));
    let none = open("", "file,stamp_ns\n").expect("a flight without frames");
    assert!(none.rows.is_empty());
}

#[test]
fn flight_toml_is_strict() {
    let csv = "file,stamp_ns\n";
    let unknown = text(open("name = \"n\"\nspeed = 3\n", csv));
    assert!(unknown.contains("line 2") && unknown.contains("speed"), "{unknown}");
    assert!(text(open("[camera]\nfov = 3\n", csv)).contains("fov"));
    assert!(text(open("schema = 2\n", csv)).contains("`schema`: expected 1, found 2"));
    for (key, toml) in [
        ("map", "map = \"../m.tif\""),
        ("map", "map = \"/m.tif\""),
        ("map", "map = \"\""),
        ("camera.hfov_deg", "[camera]\nhfov_deg = 180"),
        ("camera.hfov_deg", "[camera]\nhfov_deg = nan"),
        ("camera.mount_pitch_deg", "[camera]\nmount_pitch_deg = inf"),
    ] {
        let text = text(open(toml, csv));
        assert!(text.contains(&format!("`{key}`: expected")), "{toml}: {text}");
    }
}

#[test]
fn missing_files_are_named() {
    let folder = tempfile::tempdir().expect("a folder");
    assert!(text(Flight::open(folder.path())).contains("flight.toml"));
    std::fs::write(folder.path().join("flight.toml"), "").expect("flight.toml");
    assert!(text(Flight::open(folder.path())).contains("poses.csv"));
}

#[test]
fn a_byte_order_mark_is_no_part_of_a_name() {
    assert_eq!(open("\u{feff}schema = 1", "\u{feff}file,stamp_ns\nf.png,1\n").expect("a flight").rows.len(), 1);
}

#[test]
fn frames_are_read_from_the_folder_only_and_by_extension() {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("flight.toml"), "").expect("flight.toml");
    std::fs::write(folder.path().join("poses.csv"), "file,stamp_ns\na.PNG,1\nb.bin,2\nc.png,3\nd.png,4\n").expect("poses.csv");
    std::fs::write(folder.path().join("a.PNG"), b"abc").expect("a frame");
    std::fs::write(folder.path().join("b.bin"), b"abc").expect("a frame");
    std::fs::create_dir(folder.path().join("d.png")).expect("a folder of that name");
    let flight = Flight::open(folder.path()).expect("a flight");
    let [a, b, c, d] = flight.rows.as_slice() else { panic!("four rows") };
    assert_eq!(flight.frame(a), Ok((b"abc".to_vec(), Encoding::Png)));
    for row in [b, c, d] {
        let error = flight.frame(row).expect_err("unreadable").to_string();
        assert!(error.contains(&row.file) && !error.contains(&*folder.path().to_string_lossy()), "{error}");
    }
}
