//! The renderer's picture inside of the user interface.

use eframe::egui_wgpu::RenderState;
use egui::{Color32, Rect, TextureId, pos2};
use glam::UVec2;
use saccade_render::Renderer;
use saccade_render::wgpu::{FilterMode, TextureView};

/// The picture as the user interface knows it.
#[derive(Default)]
pub(crate) struct Picture {
    registered: Option<(TextureView, FilterMode, TextureId)>,
}

/// A place on the screen that begins and ends with whole pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Place {
    /// In points.
    pub(crate) rect: Rect,
    /// In pixels.
    pub(crate) size: UVec2,
}

impl Place {
    /// The whole pixels inside of `rect` \[points\].
    pub(crate) fn inside(rect: Rect, pixels_per_point: f32) -> Self {
        // Sizes that are whole in pixels come here with rounding errors of the division.
        let low = |points: f32| (points * pixels_per_point - 0.01).ceil().max(0.0);
        let high = |points: f32| (points * pixels_per_point + 0.01).floor().max(0.0);
        let (x0, y0) = (low(rect.min.x), low(rect.min.y));
        let (x1, y1) = (high(rect.max.x).max(x0), high(rect.max.y).max(y0));
        let at = |x: f32, y: f32| pos2(x / pixels_per_point, y / pixels_per_point);
        #[expect(
            clippy::cast_possible_truncation,
            reason = "whole numbers, far below the largest; `as` cuts what is not"
        )]
        let size = UVec2::new((x1 - x0) as u32, (y1 - y0) as u32);
        Self {
            rect: Rect::from_min_max(at(x0, y0), at(x1, y1)),
            size,
        }
    }

    /// Its size times `scale`, at least one pixel.
    pub(crate) fn scaled(self, scale: f64) -> UVec2 {
        (self.size.as_dvec2() * scale)
            .round()
            .as_uvec2()
            .max(UVec2::ONE)
    }
}

impl Picture {
    /// Paints the picture. It holds sRGB-encoded values, which is what the user interface mixes.
    pub(crate) fn paint(
        &mut self,
        painter: &egui::Painter,
        place: Place,
        renderer: &Renderer,
        state: &RenderState,
    ) {
        let texture = renderer.output_texture();
        // Pixel by pixel where it can be, smooth where it is enlarged.
        let exact = UVec2::new(texture.width(), texture.height()) == place.size;
        let filter = if exact {
            FilterMode::Nearest
        } else {
            FilterMode::Linear
        };
        let id = self.register(renderer.output(), filter, state);
        let whole = Rect::from_min_max(pos2(0.0, 0.0), pos2(1.0, 1.0));
        painter.image(id, place.rect, whole, Color32::WHITE);
    }

    fn register(
        &mut self,
        view: &TextureView,
        filter: FilterMode,
        state: &RenderState,
    ) -> TextureId {
        let mut renderer = state.renderer.write();
        let id = match &self.registered {
            Some((known, with, id)) if known == view && *with == filter => return *id,
            Some((_, _, id)) => {
                renderer.update_egui_texture_from_wgpu_texture(&state.device, view, filter, *id);
                *id
            }
            None => renderer.register_native_texture(&state.device, view, filter),
        };
        self.registered = Some((view.clone(), filter, id));
        id
    }
}

#[cfg(test)]
mod tests {
    use egui::vec2;

    use super::*;

    #[test]
    fn places_are_whole_pixels() {
        for pixels_per_point in [1.0_f32, 1.1, 1.25, 1.5, 2.0, 2.625] {
            for (width, height) in [(640_u16, 480_u16), (1, 1), (1023, 767), (3841, 2161)] {
                let size = vec2(f32::from(width), f32::from(height)) / pixels_per_point;
                let rect = Rect::from_min_size(pos2(0.0, 0.0), size);
                let place = Place::inside(rect, pixels_per_point);
                let want = UVec2::new(width.into(), height.into());
                assert_eq!(place.size, want, "at {pixels_per_point} pixels a point");
            }
        }
        let odd = Rect::from_min_max(pos2(10.3, 20.0), pos2(30.7, 20.4));
        let place = Place::inside(odd, 1.0);
        assert_eq!(
            (place.rect.min, place.size),
            (pos2(11.0, 20.0), UVec2::new(19, 0))
        );
    }

    #[test]
    fn scaled_pictures_have_pixels() {
        let place = Place::inside(Rect::from_min_size(pos2(0.0, 0.0), vec2(3.0, 801.0)), 1.0);
        assert_eq!(place.scaled(1.0), place.size);
        assert_eq!(place.scaled(0.1), UVec2::new(1, 80));
    }
}
