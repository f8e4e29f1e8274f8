//! What becomes of numbers, by examples and for any.

use proptest::prelude::*;

use super::*;

fn shown(values: &Values, stored: impl IntoIterator<Item = Vec<u8>>) -> Vec<u16> {
    let stored: Vec<u8> = stored.into_iter().flatten().collect();
    let bytes = values.convert(stored.into(), None);
    bytes
        .as_chunks()
        .0
        .iter()
        .map(|two| u16::from_le_bytes(*two))
        .collect()
}

fn fitted(number: Number, min: f64, max: f64) -> Values {
    Values::fitted(number, false, Some(Spread::Real { min, max }))
}

fn fitted_whole(number: Number, min: i128, max: i128) -> Values {
    Values::fitted(number, false, Some(Spread::Whole { min, max }))
}

#[test]
fn whole_numbers_that_fit_stay_what_they_are() {
    let u32s = |v: &[u32]| {
        v.iter()
            .map(|v| v.to_le_bytes().to_vec())
            .collect::<Vec<_>>()
    };
    let values = fitted_whole(Number::U32, 0, 40_000);
    assert_eq!(
        shown(&values, u32s(&[0, 1, 40_000, 65_535, 70_000])),
        [0, 1, 40_000, 65_535, 65_535]
    );
    // Far from 0, but close together: nothing is lost.
    let values = fitted_whole(Number::U32, 1_000_000, 1_065_000);
    assert_eq!(
        shown(&values, u32s(&[1_000_000, 1_000_001, 1_065_000])),
        [1, 2, 65_001]
    );
    assert_eq!(values.scale(), (1.0, -999_999.0));
    let i32s = [-5_i32, 0, 7].map(|v| v.to_be_bytes().to_vec());
    let spread = Spread::of(Number::I32, true, &i32s.concat());
    assert_eq!(spread, Some(Spread::Whole { min: -5, max: 7 }));
    let values = Values::fitted(Number::I32, true, spread);
    assert_eq!(shown(&values, i32s), [1, 6, 13]);
}

#[test]
fn what_does_not_fit_gets_a_window_and_is_told() {
    let f32s = [f32::NAN, -3.0, -1.0, 0.0, 3.0, 9.0].map(|v| v.to_le_bytes().to_vec());
    let values = fitted(Number::F32, -1.0, 3.0);
    assert_eq!(shown(&values, f32s), [0, 1, 1, 16_385, 65_535, 65_535]);
    let (factor, shift) = values.scale();
    assert!((3.0 * factor + shift - 65_535.0).abs() < 1e-6);
    let note = values.note().unwrap();
    assert!(
        note.contains("float32") && note.contains("-1 to 3") && note.contains("(NaN)"),
        "{note}"
    );
    let u32s = [0_u32, 1 << 31, 1 << 20].map(|v| v.to_le_bytes().to_vec());
    let values = fitted_whole(Number::U32, 0, 1 << 31);
    assert_eq!(shown(&values, u32s), [1, 65_535, 33]);
    let note = values.note().unwrap();
    assert!(!note.contains("NaN"), "{note}");
    assert!(fitted(Number::F64, 2.0, 2.0).scale().0.is_finite());
}

#[test]
fn names_stay_different_as_far_as_they_can() {
    let values = Values::names(Number::U64, false).unwrap();
    let names = (0..1000_u64).map(|n| (n * 1_000_003).to_le_bytes().to_vec());
    let mut scattered = shown(&values, names);
    assert_eq!(scattered[0], 0);
    scattered.sort_unstable();
    scattered.dedup();
    assert!(scattered.len() > 950, "{} of 1000", scattered.len());
    assert!(values.note().unwrap().contains("share"));
    // Those that fit are what they are, and what is beyond them is no one thing.
    let ids = [1_u64, 2, 65_535, 65_536, 65_537, 70_000, u64::MAX];
    let shown = shown(&values, ids.map(|v| v.to_le_bytes().to_vec()));
    assert_eq!(shown[..3], [1, 2, 65_535]);
    let mut different = shown.clone();
    different.sort_unstable();
    different.dedup();
    assert_eq!(different.len(), ids.len(), "{shown:?}");
    assert!(!shown.contains(&0));
    assert!(Values::names(Number::F32, false).is_none());
}

#[test]
fn signed_names_are_names_and_0_is_nothing() {
    let values = Values::names(Number::I16, true).unwrap();
    let stored = [0_i16, 1, 32_767, -1].map(|v| v.to_be_bytes().to_vec());
    assert_eq!(shown(&values, stored), [0, 1, 32_767, 65_535]);
    assert!(values.note().is_none());
    let values = Values::names(Number::I32, false).unwrap();
    let stored = [0_i32, 7, -7].map(|v| v.to_le_bytes().to_vec());
    let shown = shown(&values, stored);
    assert_eq!(shown[..2], [0, 7]);
    assert!(shown[2] > 7);
    assert_eq!(values.of_missing(&[0; 4]), 0);
}

#[test]
fn narrow_numbers_are_kept() {
    let values = Values::kept(Number::I16, true).unwrap();
    let stored = [-32_768_i16, 0, 32_767].map(|v| v.to_be_bytes().to_vec());
    assert_eq!(shown(&values, stored), [0, 0x8000, 0xffff]);
    assert_eq!(values.scale(), (1.0, 32_768.0));
    assert!(Values::kept(Number::U32, false).is_none());
}

/// Stored numbers of a type, from numbers that it can have.
fn stored(number: Number, numbers: &[i128]) -> Vec<Vec<u8>> {
    let bytes = |number: &i128, width: usize| number.to_le_bytes()[..width].to_vec();
    { numbers.iter() }
        .map(|one| bytes(one, number.bytes()))
        .collect()
}

fn range(number: Number) -> (i128, i128) {
    match number {
        Number::U32 => (0, u32::MAX.into()),
        Number::I32 => (i32::MIN.into(), i32::MAX.into()),
        Number::U64 => (0, u64::MAX.into()),
        Number::I64 => (i64::MIN.into(), i64::MAX.into()),
        other => panic!("{other} is not wide"),
    }
}

#[test]
fn numbers_are_told_exactly_or_briefly() {
    let (min, max) = ((1 << 63) + 5, (1 << 63) + 100_005);
    let note = fitted_whole(Number::U64, min, max).note().unwrap();
    assert!(
        note.contains("from 9223372036854775813 to 9223372036854875813 are"),
        "{note}"
    );
    let min = (1 << 62) + 10;
    let note = fitted_whole(Number::I64, min, min + 999).note().unwrap();
    assert!(note.contains("less 4611686018427387913, which"), "{note}");
    let note = fitted(Number::F64, -1.7e308, 2e-300).note().unwrap();
    assert!(note.contains("from -1.7e308 to 2e-300 are"), "{note}");
    let note = fitted(Number::F32, -501.25, 999_999.0).note().unwrap();
    assert!(note.contains("from -501.25 to 999999 are"), "{note}");
}

#[test]
fn numbers_that_lie_as_far_apart_as_they_can_are_told_apart() {
    let ends = [f64::MIN, f64::MAX];
    for [low, high] in [ends, [-1.2e308, 1.2e308], [-1.7e308, 1.7e308]] {
        let values = fitted(Number::F64, low, high);
        let numbers = [low, low / 2.0, 0.0, high / 2.0, high];
        let numbers = numbers.map(|v: f64| v.to_le_bytes().to_vec());
        let quarters = [1, 16_385, 32_768, 49_152, 65_535];
        for (got, want) in shown(&values, numbers).into_iter().zip(quarters) {
            assert!(got.abs_diff(want) <= 1, "{got} {want}");
        }
        let (factor, shift) = values.scale();
        assert!((high * factor + shift - 65_535.0).abs() < 1e-6);
    }
    for constant in [0.0, 3.0, -3e15, 1e300, f64::MAX, f64::MIN] {
        let values = fitted(Number::F64, constant, constant);
        let lone = shown(&values, [constant.to_le_bytes().to_vec()]);
        assert!(lone[0] > 0 && values.scale().0.is_finite(), "{constant}");
        assert_eq!(values.met.get(), None, "{constant}");
    }
}

/// What a chunk has beyond the end of the image is not judged.
#[test]
fn what_is_not_of_the_image_is_neither_told_nor_named() {
    let inside = Inside::new([(2, 2), (3, 2)]);
    let chunk = |numbers: [f32; 6]| Bytes::from(numbers.map(f32::to_le_bytes).concat());
    let values = fitted(Number::F32, -5.5, -3.0);
    values.convert(chunk([-5.5, -4.0, 0.0, -3.0, -3.0, 7.0]), inside.as_ref());
    assert_eq!(values.met.get(), None);
    values.convert(chunk([-5.5, -4.0, 0.0, -3.0, 7.0, 0.0]), inside.as_ref());
    assert_eq!(values.met.get(), Some(&Figure::Real(7.0)));

    let ids = |ids: [i16; 6]| Bytes::from(ids.map(i16::to_be_bytes).concat());
    let names = Values::names(Number::I16, true).unwrap();
    names.convert(ids([1, 2, -1, 3, 0, -1]), inside.as_ref());
    assert_eq!(names.renamed(), None);
    names.convert(ids([1, 2, -1, 3, -7, -1]), inside.as_ref());
    assert_eq!(names.renamed(), Some(-7));
    // Of 32 bit, and without an end.
    let wide = Values::names(Number::U32, true).unwrap();
    wide.convert(70_000_u32.to_be_bytes().to_vec().into(), None);
    assert_eq!(wide.renamed(), Some(70_000));
}

#[test]
fn negative_names_are_other_numbers_in_each_type() {
    for number in [Number::I8, Number::I16, Number::I32, Number::I64] {
        let values = Values::names(number, false).unwrap();
        let few = |ids: &[i128]| Bytes::from(stored(number, ids).concat());
        values.convert(few(&[0, 1, 127]), None);
        assert_eq!(values.renamed(), None, "{number}");
        values.convert(few(&[0, 1, -3]), None);
        assert_eq!(values.renamed(), Some(-3), "{number}");
    }
    let largest = u64::MAX;
    let values = Values::names(Number::U64, false).unwrap();
    values.convert(largest.to_le_bytes().to_vec().into(), None);
    assert_eq!(values.renamed(), Some(largest.into()));
}

/// Ranges of each wide whole type, also at its ends and across all of it, and numbers of them.
fn ranges() -> impl Strategy<Value = (Number, i128, i128, Vec<i128>)> {
    let types = vec![Number::U32, Number::I32, Number::U64, Number::I64];
    let span = prop_oneof![
        Just(u64::MAX),
        Just(65_533),
        Just(65_534),
        Just(65_535),
        Just(0),
        0..200_000_u64,
        any::<u64>()
    ];
    let at = prop_oneof![
        Just(0),
        Just(u64::MAX),
        Just(1),
        0..70_000_u64,
        any::<u64>()
    ];
    let shares = prop::collection::vec(any::<u64>(), 1..50);
    (prop::sample::select(types), span, at, shares).prop_map(|(number, span, at, shares)| {
        let (least, most) = range(number);
        let span = i128::from(span).min(most - least);
        let min = (least + i128::from(at)).min(most - span);
        let within = |share: u64| min + i128::from(share) % (span + 1);
        let mut numbers: Vec<i128> = shares.into_iter().map(within).collect();
        numbers.extend([min, min + span]);
        numbers.sort_unstable();
        (number, min, min + span, numbers)
    })
}

proptest! {
    /// Whole numbers are exact where that is said, and on a line where it is not, whatever the range.
    #[test]
    fn whole_numbers_lie_on_a_line((number, min, max, numbers) in ranges()) {
        let bytes = stored(number, &numbers);
        let spread = Spread::of(number, false, &bytes.concat());
        prop_assert_eq!(spread, Some(Spread::Whole { min, max }));
        let values = Values::fitted(number, false, spread);
        let shown = shown(&values, bytes);
        prop_assert_eq!(values.met.get(), None);
        for (number, shown) in numbers.iter().zip(shown) {
            let shown = i128::from(shown);
            if let Way::Less(less) = values.way {
                prop_assert_eq!(shown, number - less);
                let said = match less {
                    0 => "as they are".to_owned(),
                    less => format!("less {less}, which loses nothing"),
                };
                prop_assert!(values.note().unwrap().contains(&said));
                continue;
            }
            prop_assert!(max - min >= 65_535);
            if *number == 0 && min > 0 {
                prop_assert_eq!(shown, 0);
                continue;
            }
            // Half a step away at most, and as much as the arithmetic of 53 bits adds.
            let (up, span) = ((number - min) * 65_534, max - min);
            let off = ((shown - 1) * span - up).abs();
            prop_assert!(2 * off <= span + span / 100_000, "{} as {}", number, shown);
        }
    }

    /// Larger numbers are not shown as smaller ones; those that are shown as others are told.
    #[test]
    fn larger_numbers_are_not_smaller((number, min, max, _) in ranges(), (_, _, _, others) in ranges()) {
        let (least, most) = range(number);
        let mut others: Vec<i128> = others.into_iter().map(|one| one.clamp(least, most)).collect();
        others.extend([least, min, max, most]);
        others.sort_unstable();
        let values = fitted_whole(number, min, max);
        let shown = shown(&values, stored(number, &others));
        // 0 is nothing where it is below all.
        let kept = others.iter().zip(&shown).filter(|(number, _)| **number != 0);
        prop_assert!(kept.map(|(_, shown)| *shown).is_sorted());
        let beyond = |number: &i128| match values.way {
            Way::Less(0) => !(0..=65_535).contains(number),
            Way::Less(less) => *number <= less || *number > less + 65_535,
            _ => *number < min || *number > max,
        };
        let is_nothing = |number: &i128| *number == 0 && min > 0 && values.way != Way::Less(0);
        let beyond: Vec<i128> = others.into_iter().filter(|one| beyond(one) && !is_nothing(one)).collect();
        match values.met.get() {
            None => prop_assert_eq!(beyond, []),
            Some(Figure::Whole(met)) => prop_assert!(beyond.contains(met)),
            Some(met) => prop_assert!(false, "{} is no whole number", met),
        }
    }

    #[test]
    fn real_numbers_lie_on_a_line(ends: [u64; 2], shares in prop::collection::vec(0.0..=1.0_f64, 1..30)) {
        let finite = |bits: u64| Some(f64::from_bits(bits)).filter(|v| v.is_finite()).unwrap_or(f64::MAX);
        let [a, b] = ends.map(finite);
        let (min, max) = (a.min(b), a.max(b));
        prop_assume!(max / 2.0 - min / 2.0 > 1e-290);
        let values = fitted(Number::F64, min, max);
        for share in shares {
            let number = (min * (1.0 - share) + max * share).clamp(min, max);
            prop_assume!(number != 0.0);
            let shown = shown(&values, [number.to_le_bytes().to_vec()])[0];
            let want = 1.0 + 65_534.0 * share;
            prop_assert!((f64::from(shown) - want).abs() <= 0.51, "{} as {}", number, shown);
        }
        prop_assert_eq!(values.met.get(), None);
        let note = values.note().unwrap();
        prop_assert!(note.len() < 250 && !note.contains("inf "), "{}", note);
    }
}
