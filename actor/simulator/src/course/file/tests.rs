//! Course files: what they accept, and the errors that name wall, key and line.

use super::*;

const GOOD: &str = r#"
name = "two walls"
order = [7, 4]
wall_x_m = [10.0, 20.0]
wall_thickness_m = 0.3
[corridor]
length_m = 30.0
width_m = 6.0
height_m = 7.0
[start]
offset_m = 1.5
jitter_y_m = 0.5
jitter_z_m = 0.5
[[wall]]
label = 4
shape = "rectangle"
centre_m = [1.0, 3.0]
width_m = 2.0
height_m = 2.5
[[wall]]
label = 7
shape = "circle"
centre_m = [-1.0, 4.0]
diameter_m = 2.2
"#;

fn refusal(from: &str, to: &str) -> String {
    assert!(GOOD.contains(from), "{from} is not in the file");
    let text = GOOD.replacen(from, to, 1);
    match Course::parse(&text, "configs/courses/x.toml") {
        Ok(_) => panic!("{to} was accepted"),
        Err(error) => error.to_string(),
    }
}

#[track_caller]
fn assert_says(message: &str, parts: &[&str]) {
    assert!(message.starts_with("configs/courses/x.toml: "), "{message}");
    assert!(
        !message.contains('\n'),
        "{message:?} has more than one line"
    );
    for part in parts {
        assert!(message.contains(part), "{part:?} is missing in: {message}");
    }
}

#[test]
fn order_puts_walls_into_the_corridor() {
    let course = Course::parse(GOOD, "x.toml").unwrap();
    let placed: Vec<_> = course
        .walls()
        .iter()
        .map(|wall| (wall.label().0, wall.x_m()))
        .collect();
    assert_eq!(placed, [(7, 10.0), (4, 20.0)]);
    assert_eq!(course.levels(), 2);
}

#[test]
fn a_list_with_too_many_or_too_few_numbers_is_refused() {
    for (centre, count) in [("[1,5, 4,6]", 4), ("[0, 3.5, 99]", 3), ("[1.5]", 1)] {
        let message = refusal("centre_m = [-1.0, 4.0]", &format!("centre_m = {centre}"));
        let problem = format!("has {count} numbers: give 2");
        assert_says(&message, &["wall 7", "line 23", "key centre_m", &problem]);
    }
    let polygon = |points: &str| {
        let keys = format!("shape = \"polygon\"\npoints_m = {points}");
        let text = GOOD.replacen("diameter_m = 2.2", "", 1);
        let text = text.replacen("shape = \"circle\"", &keys, 1);
        Course::parse(&text, "configs/courses/x.toml")
    };
    let error = polygon("[[-1, -1], [1, -1, 5], [0, 1]]").unwrap_err();
    let parts = ["wall 7", "key points_m", "has 3 numbers"];
    assert_says(&error.to_string(), &parts);
    // Tables written as lists, whose further values the parser alone would ignore.
    let walls = GOOD.find("[[wall]]").unwrap();
    let text = GOOD[..walls].replace(
        "[corridor]\nlength_m = 30.0\nwidth_m = 6.0\nheight_m = 7.0\n",
        "corridor = [30.0, 6.0, 7.0, 9.0]\n",
    ) + &GOOD[walls..];
    let error = Course::parse(&text, "configs/courses/x.toml").unwrap_err();
    assert_says(&error.to_string(), &["corridor"]);
}

#[test]
fn a_closed_ring_is_a_polygon_and_a_repeated_corner_is_named() {
    let with = |points: &str| {
        let keys = format!("shape = \"polygon\"\npoints_m = {points}");
        let text = GOOD.replacen("diameter_m = 2.2", "", 1);
        let text = text.replacen("shape = \"circle\"", &keys, 1);
        Course::parse(&text, "configs/courses/x.toml")
    };
    let open = with("[[-1.2, -1.2], [1.2, -1.2], [1.2, 1.2], [-1.2, 1.2]]").unwrap();
    let closed = "[[-1.2, -1.2], [1.2, -1.2], [1.2, 1.2], [-1.2, 1.2], [-1.2, -1.2]]";
    assert_eq!(with(closed).unwrap(), open);
    let twice = "[[-1.2, -1.2], [1.2, -1.2], [1.2, -1.2], [1.2, 1.2], [-1.2, 1.2]]";
    let error = with(twice).unwrap_err().to_string();
    assert_says(&error, &["wall 7", "points_m", "corner 2 twice"]);
}

#[test]
fn a_name_that_breaks_a_table_is_refused() {
    for name in ["two\\nlines", "two | columns"] {
        let message = refusal("two walls", name);
        assert_says(&message, &["course: key name", "one line"]);
    }
}

#[test]
fn an_unknown_key_is_named_with_its_wall_and_line() {
    let message = refusal("diameter_m = 2.2", "diameter_m = 2.2\nradius_m = 1.1");
    assert_says(
        &message,
        &["wall 7", "radius_m", "unknown field", "line 25"],
    );
    assert_says(
        &refusal("name =", "nmae = 3\nname ="),
        &["course", "nmae", "line 2"],
    );
}

#[test]
fn a_value_of_the_wrong_kind_is_named_with_its_wall_line_and_key() {
    let says = |from, to, rest| {
        assert_eq!(refusal(from, to), format!("configs/courses/x.toml: {rest}"));
    };
    says(
        "width_m = 2.0",
        "width_m = \"wide\"",
        "wall 4: line 18: key width_m: invalid type: string \"wide\", expected f32",
    );
    says(
        "length_m = 30.0\n",
        "",
        "course: line 6: key corridor: missing field `length_m`",
    );
    says(
        "name = \"two walls\"\n",
        "",
        "course: line 1: missing field `name`",
    );
    says(
        "height_m = 2.5",
        "height_m = 2.5\nheight_m = 2",
        "wall 4: line 20: key height_m: duplicate key",
    );
    says(
        "\"rectangle\"",
        "\"oblong\"",
        "wall 4: line 16: key shape: unknown variant `oblong`, expected one of `rectangle`, \
         `circle`, `triangle`, `diamond`, `cross`, `l`, `polygon`",
    );
}

#[test]
fn a_file_that_is_not_toml_is_refused_by_wall_line_and_key() {
    assert_says(
        &refusal("diameter_m = 2.2", "diameter_m = = 2.2"),
        &["wall 7: line 24: key diameter_m: "],
    );
    assert_says(
        &refusal("[start]", "[start"),
        &["course: line 10: key start: "],
    );
}

#[test]
fn a_shape_takes_exactly_its_keys() {
    assert_says(
        &refusal("diameter_m = 2.2", ""),
        &["wall 7", "diameter_m is missing"],
    );
    let foreign = refusal("diameter_m = 2.2", "diameter_m = 2.2\narm_m = 1.0");
    assert_says(
        &foreign,
        &["wall 7", "arm_m does not belong to a circle", "remove it"],
    );
}

#[test]
fn an_opening_smaller_than_the_drone_is_refused() {
    assert_says(
        &refusal("width_m = 2.0", "width_m = 0.4"),
        &["wall 4", "width_m = 0.4 m", "narrower than the drone"],
    );
    assert_says(
        &refusal("width_m = 2.0", "width_m = 1.1"),
        &["wall 4", "radius of 0.55 m", "enlarge"],
    );
}

#[test]
fn an_opening_beyond_the_frame_is_refused() {
    assert_says(
        &refusal("[1.0, 3.0]", "[2.0, 3.0]"),
        &["wall 4", "y = 3.00 m", "centre_m"],
    );
    assert_says(
        &refusal("[-1.0, 4.0]", "[-1.0, 0.8]"),
        &["wall 7", "0.1 m <= z <= 6.90 m"],
    );
}

#[test]
fn a_polygon_that_crosses_itself_is_refused() {
    // The larger loop of a bow tie decides on its direction. The third point of each leads to the
    // fourth across the first edge.
    for (points, edges) in [
        (
            "[-1.5, -1.5], [1.5, 1.5], [1.5, -1.5], [-1.5, 1.5]",
            "1 and 3",
        ),
        (
            "[-1.5, -1.5], [1.5, 1.5], [1.5, -0.5], [-0.5, 0.5], [-1.5, 0.5]",
            "1 and 3",
        ),
        (
            "[-1.5, 1.5], [1.5, -1.5], [1.5, 0.5], [-0.5, -0.5], [-1.5, -0.5]",
            "1 and 3",
        ),
    ] {
        let message = refusal(
            "shape = \"circle\"\ncentre_m = [-1.0, 4.0]\ndiameter_m = 2.2",
            &format!("shape = \"polygon\"\npoints_m = [{points}]\ncentre_m = [0.0, 3.0]"),
        );
        let crosses = format!("crosses or touches itself (edges {edges})");
        assert_says(&message, &["wall 7", &crosses]);
    }
}

#[test]
fn walls_too_close_or_outside_are_refused() {
    assert_says(
        &refusal("[10.0, 20.0]", "[10.0, 14.0]"),
        &["wall 4", "leaves 2.50 m", "move the wall back"],
    );
    assert_says(
        &refusal("[10.0, 20.0]", "[10.0, 29.5]"),
        &["wall 4", "wall_x_m = 29.5"],
    );
    assert_says(
        &refusal("[10.0, 20.0]", "[20.0, 10.0]"),
        &[
            "wall 4",
            "wall_x_m = 10 m is not behind wall 7 at 20 m",
            "ascending",
        ],
    );
}

#[test]
fn order_must_match_walls_and_places() {
    assert_says(&refusal("[7, 4]", "[7, 5]"), &["order names wall 5"]);
    assert_says(&refusal("[7, 4]", "[7, 7]"), &["wall 7", "order"]);
    assert_says(
        &refusal("[7, 4]", "[7]"),
        &["order has 1 walls and wall_x_m 2 places"],
    );
    assert_says(&refusal("label = 7", "label = 4"), &["wall 4", "label"]);
}

#[test]
fn numbers_that_are_not_finite_or_negative_are_refused() {
    for key in ["length_m", "offset_m", "wall_thickness_m", "rotation_deg"] {
        let text = match key {
            "length_m" => GOOD.replace("length_m = 30.0", "length_m = nan"),
            "offset_m" => GOOD.replace("offset_m = 1.5", "offset_m = inf"),
            "wall_thickness_m" => GOOD.replace("wall_thickness_m = 0.3", "wall_thickness_m = -0.3"),
            _ => GOOD.replace("diameter_m", "rotation_deg = nan\ndiameter_m"),
        };
        let error = Course::parse(&text, "x.toml").unwrap_err().to_string();
        assert!(error.contains(key), "{error}");
    }
    assert_says(&refusal("[10.0, 20.0]", "[10.0, nan]"), &["wall 4", "NaN"]);
    assert_says(
        &refusal("[-1.0, 4.0]", "[nan, 4.0]"),
        &["wall 7", "centre_m = NaN"],
    );
}
