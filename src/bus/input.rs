//! Messages in: frame attachment, prior, attitude. Untrusted: sizes are bounded before parsing, fields are strict,
//! numbers are finite and in range.

use crate::geo::LatLon;
use crate::thermal::{Encoding, Pose};
use crate::track::{PriorReport, Spread};
use schemars::JsonSchema;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

/// Largest attachment, prior or attitude, bytes.
pub const MAX_MESSAGE_BYTES: usize = 4096;

/// The attachment of a frame (JSON); the payload is the image.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FrameAttachment {
    /// Exposure, Unix UTC nanoseconds.
    #[schemars(range(min = 0))]
    pub stamp_ns: i64,
    /// How to read the payload.
    pub encoding: Encoding,
    /// Width, pixels.
    #[schemars(range(min = 1, max = 4096))]
    pub width: u32,
    /// Height, pixels.
    #[schemars(range(min = 1, max = 4096))]
    pub height: u32,
    /// Height above ground, metres.
    #[schemars(extend("exclusiveMinimum" = 0, "maximum" = 100_000))]
    pub agl_m: Option<f64>,
    /// Ground metres per pixel.
    #[schemars(extend("exclusiveMinimum" = 0, "maximum" = 1000))]
    pub gsd_m: Option<f64>,
    /// Horizontal field of view, degrees.
    #[schemars(extend("exclusiveMinimum" = 0, "exclusiveMaximum" = 180))]
    pub hfov_deg: Option<f64>,
    /// Camera yaw, degrees clockwise from true north.
    #[schemars(range(min = -360, max = 360))]
    pub yaw_deg: Option<f64>,
    /// Camera pitch, degrees; 0 is nadir.
    #[schemars(range(min = -180, max = 180))]
    pub pitch_deg: Option<f64>,
    /// Camera roll, degrees.
    #[schemars(range(min = -180, max = 180))]
    pub roll_deg: Option<f64>,
}

/// A prior from outside. Exactly one of `sigma_m` and `radius_m`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(extend("oneOf" = [
    { "required": ["sigma_m"], "properties": { "sigma_m": { "type": "number" }, "radius_m": { "type": "null" } } },
    { "required": ["radius_m"], "properties": { "radius_m": { "type": "number" }, "sigma_m": { "type": "null" } } }
]))]
pub struct PriorMessage {
    /// When it held, Unix UTC nanoseconds.
    #[schemars(range(min = 0))]
    pub stamp_ns: i64,
    /// Latitude, degrees.
    #[schemars(range(min = -90, max = 90))]
    pub lat_deg: f64,
    /// Longitude, degrees.
    #[schemars(range(min = -180, max = 180))]
    pub lon_deg: f64,
    /// 1-sigma per axis, metres.
    #[schemars(extend("exclusiveMinimum" = 0, "maximum" = 10_000_000))]
    pub sigma_m: Option<f64>,
    /// Hard bound, metres.
    #[schemars(extend("exclusiveMinimum" = 0, "maximum" = 10_000_000))]
    pub radius_m: Option<f64>,
    /// The number of our fix that it echoes.
    pub fix_seq: Option<u64>,
}

/// The vehicle's attitude.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct AttitudeMessage {
    /// When it held, Unix UTC nanoseconds.
    #[schemars(range(min = 0))]
    pub stamp_ns: i64,
    /// Vehicle roll, degrees.
    #[schemars(range(min = -180, max = 180))]
    pub roll_deg: f64,
    /// Vehicle pitch, degrees.
    #[schemars(range(min = -180, max = 180))]
    pub pitch_deg: f64,
    /// Vehicle yaw, degrees clockwise from true north.
    #[schemars(range(min = -360, max = 360))]
    pub yaw_deg: f64,
    /// Height above ground, metres.
    #[schemars(extend("exclusiveMinimum" = 0, "maximum" = 100_000))]
    pub agl_m: Option<f64>,
}

/// What can be wrong with a payload.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{what}: {field}: expected {expected}, found {found}")]
pub struct InputError {
    /// Which message.
    pub what: &'static str,
    /// Which field.
    pub field: String,
    /// What it must be.
    pub expected: String,
    /// What it is.
    pub found: String,
}

impl FrameAttachment {
    /// Parses and checks an attachment.
    pub fn parse(bytes: &[u8]) -> Result<Self, InputError> {
        let message: Self = parse("frame attachment", bytes)?;
        let check = Check("frame attachment");
        check.stamp(message.stamp_ns)?;
        check.side("width", message.width)?;
        check.side("height", message.height)?;
        check.optional("agl_m", message.agl_m, Check::height)?;
        check.optional("gsd_m", message.gsd_m, |c, field, m| c.positive(field, m, 1000.0))?;
        check.optional("hfov_deg", message.hfov_deg, |c, field, deg| {
            c.require(field, deg > 0.0 && deg < 180.0, "more than 0 and less than 180", deg)
        })?;
        check.optional("yaw_deg", message.yaw_deg, Check::heading)?;
        check.optional("pitch_deg", message.pitch_deg, Check::angle)?;
        check.optional("roll_deg", message.roll_deg, Check::angle)?;
        Ok(message)
    }

    /// The stamp of an attachment that is otherwise refused, where it can be read: so that its frame gets an answer.
    pub fn stamp_of_refused(bytes: &[u8]) -> Option<i64> {
        let bytes = bytes.get(..MAX_MESSAGE_BYTES.min(bytes.len())).filter(|b| b.len() == bytes.len())?;
        let value: serde_json::Value = serde_json::from_slice(bytes).ok()?;
        value.get("stamp_ns")?.as_i64().filter(|stamp_ns| *stamp_ns >= 0)
    }

    /// The camera's pose, as far as the attachment states it.
    pub fn pose(&self) -> Pose {
        Pose {
            agl_m: self.agl_m,
            gsd_m: self.gsd_m,
            hfov_deg: self.hfov_deg,
            yaw_deg: self.yaw_deg,
            pitch_deg: self.pitch_deg,
            roll_deg: self.roll_deg,
        }
    }
}

impl PriorMessage {
    /// Parses and checks a prior.
    pub fn parse(bytes: &[u8]) -> Result<Self, InputError> {
        let message: Self = parse("prior", bytes)?;
        message.report()?;
        Ok(message)
    }

    /// The checked prior, as the tracker takes it.
    pub fn report(&self) -> Result<PriorReport, InputError> {
        let check = Check("prior");
        check.stamp(self.stamp_ns)?;
        check.between("lat_deg", self.lat_deg, 90.0)?;
        check.between("lon_deg", self.lon_deg, 180.0)?;
        let spread = match (self.sigma_m, self.radius_m) {
            (Some(sigma_m), None) => {
                check.positive("sigma_m", sigma_m, 1e7)?;
                Spread::SigmaM(sigma_m)
            }
            (None, Some(radius_m)) => {
                check.positive("radius_m", radius_m, 1e7)?;
                Spread::RadiusM(radius_m)
            }
            (Some(_), Some(_)) => return Err(check.error("sigma_m, radius_m", "exactly one", "both")),
            (None, None) => return Err(check.error("sigma_m, radius_m", "exactly one", "neither")),
        };
        let position = LatLon::new(self.lat_deg, self.lon_deg)
            .ok_or_else(|| check.error("lat_deg, lon_deg", "a position", format!("{}, {}", self.lat_deg, self.lon_deg)))?;
        Ok(PriorReport { stamp_ns: self.stamp_ns, position, spread, fix_seq: self.fix_seq })
    }
}

impl AttitudeMessage {
    /// Parses and checks an attitude.
    pub fn parse(bytes: &[u8]) -> Result<Self, InputError> {
        let message: Self = parse("attitude", bytes)?;
        let check = Check("attitude");
        check.stamp(message.stamp_ns)?;
        check.angle("roll_deg", message.roll_deg)?;
        check.angle("pitch_deg", message.pitch_deg)?;
        check.heading("yaw_deg", message.yaw_deg)?;
        check.optional("agl_m", message.agl_m, Check::height)?;
        Ok(message)
    }
}

/// Parses JSON of bounded size.
fn parse<T: DeserializeOwned>(what: &'static str, bytes: &[u8]) -> Result<T, InputError> {
    let check = Check(what);
    if bytes.len() > MAX_MESSAGE_BYTES {
        return Err(check.error("size", format!("at most {MAX_MESSAGE_BYTES} bytes"), format!("{} bytes", bytes.len())));
    }
    // serde would also take an array of the fields in order.
    if bytes.iter().find(|b| !b.is_ascii_whitespace()) != Some(&b'{') {
        return Err(check.error("JSON", format!("an object of {what}"), "something else"));
    }
    serde_json::from_slice(bytes).map_err(|e| check.error("JSON", format!("an object of {what}"), e))
}

/// Checks the fields of one kind of message.
#[derive(Clone, Copy)]
struct Check(&'static str);

impl Check {
    fn error(self, field: &str, expected: impl Into<String>, found: impl ToString) -> InputError {
        InputError { what: self.0, field: field.to_owned(), expected: expected.into(), found: found.to_string() }
    }
    fn require(self, field: &str, fits: bool, expected: impl Into<String>, found: impl ToString) -> Result<(), InputError> {
        if fits { Ok(()) } else { Err(self.error(field, expected, found)) }
    }
    fn optional(
        self,
        field: &str,
        value: Option<f64>,
        check: impl Fn(Self, &str, f64) -> Result<(), InputError>,
    ) -> Result<(), InputError> {
        value.map_or(Ok(()), |value| check(self, field, value))
    }
    fn stamp(self, stamp_ns: i64) -> Result<(), InputError> {
        self.require("stamp_ns", stamp_ns >= 0, "0 or more", stamp_ns)
    }
    fn side(self, field: &str, px: u32) -> Result<(), InputError> {
        self.require(field, (1..=4096).contains(&px), "1 to 4096", px)
    }
    fn positive(self, field: &str, value: f64, most: f64) -> Result<(), InputError> {
        self.require(field, value > 0.0 && value <= most, format!("more than 0 and at most {most}"), value)
    }
    fn between(self, field: &str, value: f64, bound: f64) -> Result<(), InputError> {
        self.require(field, value.abs() <= bound, format!("-{bound} to {bound}"), value)
    }
    fn height(self, field: &str, m: f64) -> Result<(), InputError> {
        self.positive(field, m, 100_000.0)
    }
    fn heading(self, field: &str, deg: f64) -> Result<(), InputError> {
        self.between(field, deg, 360.0)
    }
    fn angle(self, field: &str, deg: f64) -> Result<(), InputError> {
        self.between(field, deg, 180.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::{Value, json};

    fn frame() -> Value {
        json!({"stamp_ns": 17, "encoding": "png", "width": 640, "height": 512})
    }
    fn prior() -> Value {
        json!({"stamp_ns": 17, "lat_deg": 25.2, "lon_deg": 55.3, "radius_m": 512.0})
    }
    fn attitude() -> Value {
        json!({"stamp_ns": 17, "roll_deg": 1.0, "pitch_deg": -2.0, "yaw_deg": 359.0, "agl_m": 400.0})
    }
    fn with(mut value: Value, key: &str, to: Value) -> Vec<u8> {
        value[key] = to;
        value.to_string().into_bytes()
    }
    fn without(mut value: Value, key: &str) -> Vec<u8> {
        value.as_object_mut().unwrap().remove(key);
        value.to_string().into_bytes()
    }

    #[test]
    fn what_the_contract_names_is_taken() {
        let bytes = json!({"stamp_ns": 17, "encoding": "y16le", "width": 640, "height": 512, "agl_m": 400.5, "gsd_m": 0.9,
            "hfov_deg": 32, "yaw_deg": -10, "pitch_deg": 3.5, "roll_deg": 0});
        let message = FrameAttachment::parse(bytes.to_string().as_bytes()).unwrap();
        assert_eq!((message.encoding, message.width, message.height), (Encoding::Y16le, 640, 512));
        assert_eq!(message.pose().agl_m, Some(400.5));
        let least = FrameAttachment::parse(frame().to_string().as_bytes()).unwrap();
        assert_eq!(least.pose(), Pose::default(), "absent is unknown, never zero");
        let message = PriorMessage::parse(prior().to_string().as_bytes()).unwrap();
        assert_eq!(message.report().unwrap().spread, Spread::RadiusM(512.0));
        assert!(PriorMessage::parse(&with(without_value(prior(), "radius_m"), "sigma_m", json!(3))).is_ok());
        assert!(AttitudeMessage::parse(attitude().to_string().as_bytes()).is_ok());
        assert!(AttitudeMessage::parse(&without(attitude(), "agl_m")).is_ok());
    }

    fn without_value(mut value: Value, key: &str) -> Value {
        value.as_object_mut().unwrap().remove(key);
        value
    }

    #[test]
    fn missing_unknown_and_mistyped_fields_are_refused() {
        for key in ["stamp_ns", "encoding", "width", "height"] {
            assert!(FrameAttachment::parse(&without(frame(), key)).is_err(), "{key}");
        }
        for key in ["stamp_ns", "lat_deg", "lon_deg", "radius_m"] {
            assert!(PriorMessage::parse(&without(prior(), key)).is_err(), "{key}");
        }
        for key in ["stamp_ns", "roll_deg", "pitch_deg", "yaw_deg"] {
            assert!(AttitudeMessage::parse(&without(attitude(), key)).is_err(), "{key}");
        }
        let error = FrameAttachment::parse(&with(frame(), "agl", json!(1))).unwrap_err().to_string();
        assert!(error.contains("unknown field `agl`"), "{error}");
        for bad in [json!("17"), json!(1.5), json!(-1), json!(1e30), Value::Null] {
            assert!(FrameAttachment::parse(&with(frame(), "stamp_ns", bad)).is_err());
        }
        assert!(FrameAttachment::parse(&with(frame(), "encoding", json!("bmp"))).is_err());
        assert!(PriorMessage::parse(&with(prior(), "fix_seq", json!(-1))).is_err());
    }

    #[test]
    fn exactly_one_of_sigma_and_radius() {
        let both = PriorMessage::parse(&with(prior(), "sigma_m", json!(3))).unwrap_err();
        assert_eq!((both.expected.as_str(), both.found.as_str()), ("exactly one", "both"));
        let neither = PriorMessage::parse(&without(prior(), "radius_m")).unwrap_err();
        assert_eq!(neither.found, "neither");
    }

    #[test]
    fn ranges_are_kept() {
        for (key, bad) in [
            ("width", json!(0)),
            ("height", json!(4097)),
            ("agl_m", json!(0)),
            ("gsd_m", json!(-1)),
            ("hfov_deg", json!(180)),
            ("yaw_deg", json!(361)),
            ("pitch_deg", json!(-181)),
            ("roll_deg", json!(1e9)),
        ] {
            let error = FrameAttachment::parse(&with(frame(), key, bad)).unwrap_err();
            assert_eq!(error.field, key);
        }
        for (key, bad) in [("lat_deg", json!(90.1)), ("lon_deg", json!(-181)), ("radius_m", json!(0)), ("radius_m", json!(1e8))] {
            assert_eq!(PriorMessage::parse(&with(prior(), key, bad)).unwrap_err().field, key);
        }
        for (key, bad) in [("roll_deg", json!(200)), ("pitch_deg", json!(200)), ("yaw_deg", json!(-400)), ("agl_m", json!(-3))] {
            assert_eq!(AttitudeMessage::parse(&with(attitude(), key, bad)).unwrap_err().field, key);
        }
    }

    #[test]
    fn garbage_is_an_error_not_a_panic() {
        let deep = "[".repeat(4000);
        let duplicate = br#"{"stamp_ns":1,"stamp_ns":2,"encoding":"png","width":1,"height":1}"#;
        for bytes in [
            &b""[..],
            b"[17,\"png\",640,512,null,null,null,null,null,null]",
            b"[17,25.2,55.3,null,512.0,null]",
            b"\xff\xfe",
            b"null",
            b"[]",
            b"{",
            b"{\"stamp_ns\": NaN}",
            b"1e999",
            deep.as_bytes(),
            duplicate,
        ] {
            assert!(FrameAttachment::parse(bytes).is_err());
            assert!(PriorMessage::parse(bytes).is_err());
            assert!(AttitudeMessage::parse(bytes).is_err());
            let _ = FrameAttachment::stamp_of_refused(bytes);
        }
        let mut huge = frame().to_string().into_bytes();
        huge.resize(MAX_MESSAGE_BYTES + 1, b' ');
        assert_eq!(FrameAttachment::parse(&huge).unwrap_err().field, "size");
        assert_eq!(FrameAttachment::stamp_of_refused(&huge), None);
    }

    #[test]
    fn the_stamp_of_a_refused_attachment_is_found() {
        let bytes = with(frame(), "encoding", json!("bmp"));
        assert!(FrameAttachment::parse(&bytes).is_err());
        assert_eq!(FrameAttachment::stamp_of_refused(&bytes), Some(17));
        assert_eq!(FrameAttachment::stamp_of_refused(&with(frame(), "stamp_ns", json!("17"))), None);
        assert_eq!(FrameAttachment::stamp_of_refused(&with(frame(), "stamp_ns", json!(-17))), None);
    }
}
