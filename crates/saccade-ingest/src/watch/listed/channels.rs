//! Which channels the images of a list show.

use std::collections::HashMap;

use saccade_archive::acquisition::tile_list::decoded;

use super::super::Pattern;
use super::source::{Listing, Named};
use super::{ListConfig, ListError};
use crate::replay::lists::channel_names;

/// Images of which the names do not say the channel.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Unfit {
    count: usize,
    first: String,
    why: String,
}

impl Unfit {
    /// What is said of them, beside so many others.
    pub(super) fn said(&self, others: usize, pattern: &str) -> String {
        let Self { count, first, why } = self;
        let all = count + others;
        format!(
            "{count} of the {all} images that the list names do not fit --channel-in {pattern}, such as {first:?}: {why}"
        )
    }
}

/// The channel that a name says, or why it says none.
pub(super) fn channel_of(pattern: &Pattern, file: &str) -> Result<String, String> {
    // Part of a URL means what it is decoded.
    let meant = decoded(file).and_then(|file| pattern.channel(&file).ok());
    meant.map_or_else(|| pattern.channel(file), Ok)
}

impl Listing {
    /// The channels that it names, in the order in which it does.
    pub(super) fn channels(&self) -> Vec<String> {
        let mut tiles: Vec<&Named> = self.tiles.iter().collect();
        tiles.sort_by_key(|tile| tile.order);
        channel_names(tiles.into_iter().map(|tile| tile.channel.as_deref()))
    }

    /// Takes the channels from the names of the images; those that do not say one are left out.
    pub(super) fn take_channels(&mut self, config: &ListConfig) {
        let Some(pattern) = &config.channel_in else {
            return;
        };
        let mut unfit: Option<Unfit> = None;
        self.tiles.retain_mut(|tile| {
            if tile.channel.is_some() {
                return true;
            }
            match channel_of(pattern, &tile.file) {
                Ok(channel) => {
                    tile.channel = Some(channel);
                    true
                }
                Err(why) => {
                    let unfit = unfit.get_or_insert_with(|| Unfit {
                        count: 0,
                        first: tile.file.clone(),
                        why,
                    });
                    unfit.count += 1;
                    false
                }
            }
        });
        self.unfit = unfit;
    }

    /// Takes those that registration does not know along with another channel at the same place: one channel is registered,
    /// and all were imaged at once.
    pub(super) fn take_along(&mut self) {
        let Some(own) = &mut self.own else {
            return;
        };
        let place = |tile: &Named| (tile.section, tile.stage.elements().map(f64::to_bits));
        let mut known = HashMap::new();
        for tile in { self.tiles.iter() }.filter(|tile| tile.channel.is_some()) {
            if let Some(transform) = own.transforms.get(&tile.known_as) {
                known.entry(place(tile)).or_insert(*transform);
            }
        }
        for tile in { self.tiles.iter() }.filter(|tile| tile.channel.is_some()) {
            if let Some(transform) = known.get(&place(tile)) {
                own.transforms
                    .entry(tile.known_as.clone())
                    .or_insert(*transform);
            }
        }
    }

    /// Whether any image is left.
    ///
    /// # Errors
    ///
    /// [`ListError::Unfit`].
    pub(super) fn check_fit(&self, config: &ListConfig) -> Result<(), ListError> {
        let unfit = self.unfit.as_ref().zip(config.channel_in.as_ref());
        let Some((Unfit { first, why, .. }, pattern)) = unfit.filter(|_| self.tiles.is_empty())
        else {
            return Ok(());
        };
        Err(ListError::Unfit {
            pattern: pattern.to_string(),
            first: first.clone(),
            why: why.clone(),
            list: config.list.clone(),
        })
    }

    /// Whether it can be told of which of several channels its images are.
    ///
    /// # Errors
    ///
    /// [`ListError::Channels`].
    pub(super) fn check_channels(&self, config: &ListConfig) -> Result<(), ListError> {
        let several = { config.channels.as_ref() }.is_some_and(|channels| channels.len() > 1);
        if several && !self.tiles.is_empty() && self.channels().is_empty() {
            let list = config.list.clone();
            return Err(ListError::Channels { list });
        }
        Ok(())
    }
}
