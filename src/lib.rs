//! nightfix: where is the drone, at night, without GNSS?
//!
//! A nadir thermal (LWIR) frame and the last known position go in. Out comes a position fix with an error, or a
//! plain "no fix" with its reason.
//!
//! ```text
//! frame bytes -> thermal::{decode, tone, rectify} -> 512 x 512 m, north-up, 1 m/px
//! prior       -> track -> search disc
//! map         -> map::{GeoTiff, MapCache, Window} -> metric window, ENU axes
//!                  both -> locate::Localizer: coarse, crop, refine (model), DLT (homography), gates
//!                       -> geo: pixel -> latitude/longitude -> bus::message::FixMessage -> Zenoh, replay, CLI
//! ```
//!
//! One [`locate::Ladder`] of localizers serves the daemon, replay, the `locate` command and the tests. It is synchronous, takes
//! all it needs as arguments, touches neither network nor clock, and gives the same answer for the same input.
//!
//! Reference: Xiao et al., STHN: Deep Homography Estimation for UAV Thermal Geo-localization with Satellite Imagery,
//! IEEE RA-L 9(10), 2024.

pub mod bus;
pub mod cli;
pub mod config;
pub mod daemon;
pub mod flight;
pub mod geo;
pub mod homography;
pub mod locate;
pub mod map;
pub mod model;
pub mod survey;
pub mod thermal;
pub mod track;
