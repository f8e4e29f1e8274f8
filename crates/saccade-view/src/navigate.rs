//! From hands and keys to cameras.

use glam::DVec2;
use saccade_core::camera::Camera;

/// What the user did to the picture since the last frame. Movements are in points.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Input {
    /// Movement with the first button held, or one finger.
    pub(crate) primary: DVec2,
    /// Movement with the second or middle button held.
    pub(crate) other: DVec2,
    /// Movement of two fingers.
    pub(crate) fingers: DVec2,
    /// How much farther apart two fingers are, as a factor; 0 for no fingers.
    pub(crate) pinch: f64,
    /// Movement of the wheel, up positive.
    pub(crate) wheel: f64,
    /// Arrow keys held: right and down positive, -1 to 1.
    pub(crate) arrows: DVec2,
    /// Keys for closer (positive) and farther, -1 to 1.
    pub(crate) closer: f64,
    /// Whether shift is held.
    pub(crate) shift: bool,
    /// Double click, or a key for it.
    pub(crate) reset: bool,
    /// Since the last frame \[s\].
    pub(crate) seconds: f64,
}

/// Degrees that one turn of the hand across the picture's height makes.
const TURN: f64 = 180.0;
/// Points of the wheel that make the volume e times as large.
const WHEEL: f64 = 250.0;
/// Degrees a second that an arrow key turns, picture heights a second it pans.
const KEY_TURN: f64 = 60.0;
const KEY_PAN: f64 = 0.5;
/// Growth a second of the keys for closer: a factor of e.
const KEY_ZOOM: f64 = 1.0;

/// The camera after `input` on a picture `height` points high; `home` is where resets lead.
pub(crate) fn moved(camera: Camera, input: &Input, height: f64, home: Camera) -> Camera {
    if input.reset {
        return home;
    }
    let height = height.max(1.0);
    let keys = input.arrows * input.seconds;
    let (turn, mut pan) = if input.shift {
        (
            DVec2::ZERO,
            input.primary + input.other - keys * KEY_PAN * height,
        )
    } else {
        (input.primary * TURN / height - keys * KEY_TURN, input.other)
    };
    pan += input.fingers;
    let mut camera = camera;
    // The volume follows the hand: the eye goes the other way. Keys move the eye itself.
    if turn != DVec2::ZERO {
        camera = camera.orbited(-turn.x, turn.y);
    }
    if pan != DVec2::ZERO {
        camera = camera.panned(pan, height);
    }
    let zoom = input.wheel / WHEEL + input.closer * KEY_ZOOM * input.seconds;
    let factor = zoom.exp() * if input.pinch > 0.0 { input.pinch } else { 1.0 };
    if factor != 1.0 && factor.is_finite() && factor > 0.0 {
        camera = camera.zoomed(factor);
    }
    camera
}

#[cfg(test)]
mod tests {
    use glam::{DVec3, UVec3, dvec2};
    use saccade_core::volume::Volume;

    use super::*;

    const HEIGHT: f64 = 500.0;

    fn home() -> Camera {
        let volume = Volume::new("v", UVec3::new(100, 80, 60), DVec3::splat(4.0)).unwrap();
        Camera {
            yaw: 0.0,
            pitch: 0.0,
            ..Camera::around(&volume)
        }
    }

    /// Where on the picture a point of the volume appears, relative to its middle \[points\].
    fn seen(camera: Camera, point: DVec3) -> DVec2 {
        let axes = camera.physical_from_eye_axes();
        let eye = axes.transpose() * (point - camera.eye().xyz);
        let tangent = (camera.fov / 2.0).to_radians().tan();
        dvec2(eye.x, eye.y) / eye.z / tangent * HEIGHT / 2.0
    }

    fn after(input: Input) -> Camera {
        moved(home(), &input, HEIGHT, home())
    }

    #[test]
    fn no_input_changes_nothing() {
        let camera = home().orbited(3.0, 4.0);
        assert_eq!(moved(camera, &Input::default(), HEIGHT, home()), camera);
    }

    #[test]
    fn the_near_side_follows_the_hand() {
        let near = home().target.xyz - DVec3::Z * 100.0;
        for by in [dvec2(30.0, 0.0), dvec2(0.0, 30.0), dvec2(-20.0, -20.0)] {
            let camera = after(Input {
                primary: by,
                ..Input::default()
            });
            assert!(seen(camera, near).dot(by) > 0.0, "dragged by {by}");
        }
    }

    #[test]
    fn the_target_follows_the_hand_when_panned() {
        let by = dvec2(40.0, -25.0);
        let target = home().target.xyz;
        for input in [
            Input {
                other: by,
                ..Input::default()
            },
            Input {
                primary: by,
                shift: true,
                ..Input::default()
            },
            Input {
                fingers: by,
                ..Input::default()
            },
        ] {
            let at = seen(after(input), target);
            assert!((at - by).length() < 1e-6, "{at} for {input:?}");
        }
    }

    #[test]
    fn wheel_pinch_and_keys_bring_it_closer() {
        for input in [
            Input {
                wheel: 50.0,
                ..Input::default()
            },
            Input {
                pinch: 1.2,
                ..Input::default()
            },
            Input {
                closer: 1.0,
                seconds: 0.1,
                ..Input::default()
            },
        ] {
            assert!(after(input).distance_nm < home().distance_nm, "{input:?}");
        }
        let back = Input {
            wheel: -50.0,
            ..Input::default()
        };
        let there = moved(
            home(),
            &Input {
                wheel: 50.0,
                ..back
            },
            HEIGHT,
            home(),
        );
        let again = moved(there, &back, HEIGHT, home()).distance_nm;
        assert!(
            (again / home().distance_nm - 1.0).abs() < 1e-12,
            "the wheel is reversible"
        );
    }

    #[test]
    fn keys_move_the_eye_as_fast_as_time_passes() {
        let key = |seconds| Input {
            arrows: dvec2(1.0, 0.0),
            seconds,
            ..Input::default()
        };
        assert!(
            after(key(0.1)).eye().xyz.x > home().eye().xyz.x,
            "right moves the eye right"
        );
        let twice = moved(after(key(0.1)), &key(0.1), HEIGHT, home());
        assert!((twice.yaw - after(key(0.2)).yaw).abs() < 1e-9);
        let up = Input {
            arrows: dvec2(0.0, -1.0),
            seconds: 0.1,
            ..Input::default()
        };
        assert!(
            after(up).eye().xyz.y < home().eye().xyz.y,
            "up moves the eye up"
        );
    }

    #[test]
    fn poisoned_input_leaves_a_usable_camera() {
        for pinch in [f64::NAN, f64::INFINITY, -1.0, 0.0] {
            let camera = after(Input {
                pinch,
                ..Input::default()
            });
            assert_eq!(camera, home(), "pinch {pinch}");
        }
    }

    #[test]
    fn reset_leads_home() {
        let away = home().orbited(50.0, 10.0).zoomed(3.0);
        let input = Input {
            reset: true,
            wheel: 10.0,
            ..Input::default()
        };
        assert_eq!(moved(away, &input, HEIGHT, home()), home());
    }
}
