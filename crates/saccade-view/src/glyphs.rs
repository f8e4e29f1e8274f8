//! Signs that the fonts lack.
//!
//! The fonts with all of them are a megabyte, for the one sign in the window that chooses colours.

use egui::epaint::text::{GlyphBitmap, GlyphRasterizer, RasterizedGlyph};
use egui::{Color32, ColorImage, Context, Vec2, vec2};

/// On the button that copies a colour.
const COPY: &str = "📋";

/// Draws what the fonts lack.
pub(crate) fn provide(context: &Context) {
    context.add_glyph_rasterizer(GlyphRasterizer::new("saccade_view::glyphs", |wanted| {
        (wanted.cluster == COPY).then(|| copy(wanted.font_size_px))
    }));
}

/// Two sheets, one in front of the other, in a font of some height \[pixels\].
fn copy(height: f32) -> RasterizedGlyph {
    let size = (height * 0.9).ceil().max(4.0);
    // Of the sign's size.
    let (sheet, line) = (vec2(0.56, 0.68), (0.075_f32).max(1.0 / size));
    let (behind, front) = (vec2(0.08, 0.08), vec2(0.34, 0.24));
    // How far inside an edge a place lies, negative outside.
    let inside = |at: Vec2, corner: Vec2| {
        let from = at - corner;
        let to = corner + sheet - at;
        from.x.min(from.y).min(to.x).min(to.y)
    };
    // Edges are a pixel soft.
    let covered = |distance: f32| (distance * size + 0.5).clamp(0.0, 1.0);
    let outline = |depth: f32| covered(depth).min(covered(line - depth));
    #[expect(clippy::cast_possible_truncation, reason = "as large as a letter")]
    #[expect(clippy::cast_sign_loss, reason = "4 at least")]
    let pixels = size as usize;
    let alpha = (0..pixels * pixels).map(|index| {
        let middle = |n: usize| (n as f32 + 0.5) / size;
        let at = vec2(middle(index % pixels), middle(index / pixels));
        let in_front = inside(at, front);
        let hidden = covered(in_front + line);
        let behind = outline(inside(at, behind)) * (1.0 - hidden);
        outline(in_front).max(behind)
    });
    let image = ColorImage::new(
        [pixels, pixels],
        alpha
            .map(|alpha| Color32::WHITE.gamma_multiply(alpha))
            .collect(),
    );
    RasterizedGlyph {
        bitmap: GlyphBitmap {
            image,
            // From the line that letters stand on.
            offset_px: vec2(0.0, -0.85 * size),
            is_color: false,
        },
        advance_px: size,
    }
}

#[cfg(test)]
mod tests {
    use egui::{FontId, RawInput};

    use super::*;

    /// Where the sign lies among all that are drawn, and where one lies that nobody knows.
    fn places(context: &Context) -> [[u16; 2]; 2] {
        let mut places = [[0; 2]; 2];
        drop(context.run_ui(RawInput::default(), |ui| {
            for (place, text) in places.iter_mut().zip([COPY, "\u{10fffd}"]) {
                let font = FontId::proportional(14.0);
                let text = text.to_owned();
                let laid = ui.fonts_mut(|fonts| fonts.layout_no_wrap(text, font, Color32::WHITE));
                *place = laid.rows[0].glyphs[0].uv_rect.min;
            }
        }));
        places
    }

    #[test]
    fn the_sign_of_copying_is_drawn() {
        let context = Context::default();
        let [sign, unknown] = places(&context);
        assert_eq!(sign, unknown, "the fonts have it by now");
        provide(&context);
        let [sign, unknown] = places(&context);
        assert_ne!(sign, unknown);
    }

    #[test]
    fn it_is_two_sheets_of_any_size() {
        for height in [9.0, 14.0, 40.0] {
            let sign = copy(height).bitmap.image;
            let [width, rows] = sign.size;
            let lit = sign.pixels.iter().filter(|p| p.a() > 128).count();
            let share = lit as f32 / (width * rows) as f32;
            assert!((0.1..0.6).contains(&share), "{share} of {width} x {rows}");
            // Along the diagonal: four edges, of which the second of the sheet behind is hidden.
            let diagonal = (0..width).map(|n| sign.pixels[n * width + n].a() > 100);
            let edges: Vec<bool> = diagonal.collect();
            let rises = edges.windows(2).filter(|pair| !pair[0] && pair[1]).count();
            assert!((2..=3).contains(&rises), "{height}: {edges:?}");
        }
    }
}
