//! How many streams of changes there may be, and whose.
//!
//! Streams last, so that whoever opens many keeps them. There is no fixed number for each address: behind a proxy, or one
//! address of an institute, many people are one client. Instead nobody is refused for the sake of somebody who has more: when
//! all places are taken, the client with the most gives one up.

use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv6Addr};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::Notify;

/// The streams of a server.
#[derive(Debug)]
pub(crate) struct Streams {
    most: usize,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    /// Of every client that has any, oldest first.
    clients: BTreeMap<IpAddr, Vec<(u64, Arc<Notify>)>>,
    open: usize,
    /// Streams that were ever opened.
    count: u64,
}

impl Streams {
    pub(crate) fn new(most: usize) -> Arc<Self> {
        Arc::new(Self {
            most,
            state: Mutex::default(),
        })
    }

    /// A place for one more stream of a client, perhaps in place of one of another client's. `None` where no other client has at
    /// least two more.
    pub(crate) fn admit(self: &Arc<Self>, address: IpAddr) -> Option<StreamPlace> {
        let client = client(address);
        let mut state = self.state();
        if state.open >= self.most {
            let own = state.clients.get(&client).map_or(0, Vec::len);
            let (_, largest) = { state.clients.iter_mut() }.max_by_key(|(_, all)| all.len())?;
            // Otherwise the two would push each other out for ever.
            if largest.len() < own + 2 {
                return None;
            }
            // The newest: those that were there before it are not disturbed.
            let (_, gone) = largest.pop()?;
            state.open -= 1;
            gone.notify_one();
        }
        state.open += 1;
        state.count += 1;
        let (number, evicted) = (state.count, Arc::new(Notify::new()));
        let all = state.clients.entry(client).or_default();
        all.push((number, evicted.clone()));
        drop(state);
        Some(StreamPlace {
            all: self.clone(),
            client,
            number,
            evicted,
        })
    }

    fn state(&self) -> MutexGuard<'_, State> {
        // Nothing is left half-changed by a panic elsewhere.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Whoever has an address of version 6 has all those that begin alike.
fn client(address: IpAddr) -> IpAddr {
    /// What networks give to one customer: the first 64 bits.
    const NETWORK: u128 = !(u64::MAX as u128);
    match address.to_canonical() {
        IpAddr::V6(address) => Ipv6Addr::from_bits(address.to_bits() & NETWORK).into(),
        address => address,
    }
}

/// The place of one stream, until it is dropped.
#[derive(Debug)]
pub(crate) struct StreamPlace {
    all: Arc<Streams>,
    client: IpAddr,
    number: u64,
    evicted: Arc<Notify>,
}

impl StreamPlace {
    /// Done when the stream has to end for somebody else's.
    pub(crate) fn evicted(&self) -> impl Future<Output = ()> + Send + 'static {
        let evicted = self.evicted.clone();
        async move { evicted.notified().await }
    }
}

impl Drop for StreamPlace {
    fn drop(&mut self) {
        let mut state = self.all.state();
        let State { clients, open, .. } = &mut *state;
        let Some(all) = clients.get_mut(&self.client) else {
            return;
        };
        // One that had to go is not there any more.
        if let Some(at) = all.iter().position(|(number, _)| *number == self.number) {
            all.remove(at);
            *open -= 1;
        }
        if all.is_empty() {
            clients.remove(&self.client);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use futures::FutureExt;

    const GREEDY: IpAddr = IpAddr::V4(std::net::Ipv4Addr::new(192, 0, 2, 1));
    const GOOD: IpAddr = IpAddr::V4(std::net::Ipv4Addr::new(192, 0, 2, 2));
    const LATE: IpAddr = IpAddr::V4(std::net::Ipv4Addr::new(192, 0, 2, 3));

    fn gone(places: &[StreamPlace]) -> Vec<bool> {
        let gone = |place: &StreamPlace| place.evicted().now_or_never().is_some();
        places.iter().map(gone).collect()
    }

    #[test]
    fn who_has_most_makes_room_for_others_and_not_for_itself() {
        let streams = Streams::new(5);
        let mut greedy: Vec<_> = (0..5).map_while(|_| streams.admit(GREEDY)).collect();
        assert_eq!(greedy.len(), 5, "nobody else wants any");
        assert!(streams.admit(GREEDY).is_none());
        let good = [(); 2].map(|()| streams.admit(GOOD).unwrap());
        assert_eq!(gone(&greedy), [false, false, false, true, true]);
        // 3 and 2: neither takes from the other.
        assert!(streams.admit(GOOD).is_none() && streams.admit(GREEDY).is_none());
        let late = streams.admit(LATE).unwrap();
        assert_eq!(gone(&greedy[..3]), [false, false, true]);
        assert_eq!(gone(&good), [false, false]);
        assert_eq!(streams.state().open, 5);
        // What ended is dropped at any time, and gives back nothing twice.
        greedy.truncate(2);
        assert_eq!(streams.state().open, 5);
        drop((greedy, good, late));
        let state = streams.state();
        assert_eq!((state.open, state.clients.len()), (0, 0));
    }

    #[test]
    fn one_network_is_one_client() {
        let streams = Streams::new(4);
        let address = |text: &str| text.parse::<IpAddr>().unwrap();
        let many = (1..5).map(|n| streams.admit(address(&format!("2001:db8:1:2::{n}"))));
        let many: Vec<_> = many.map(Option::unwrap).collect();
        assert!(streams.admit(address("2001:db8:1:2:3:4:5:6")).is_none());
        let other = streams.admit(address("2001:db8:1:3::1")).unwrap();
        assert_eq!(gone(&many), [false, false, false, true]);
        let mapped = streams.admit(address("::ffff:192.0.2.1")).unwrap();
        assert_eq!(mapped.client, GREEDY);
        drop((many, other, mapped));
        assert!(streams.state().clients.is_empty());
    }
}
