//! A stream that shows heads of requests whole or not at all.
//!
//! Whoever parses a head byte by byte as it drips in does so as often as it drips. Here bytes are held until a blank line ends
//! what they begin; who waits for that is told in [`Flow`], so that it can wait elsewhere.

use std::io::{self, IoSlice};
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, Waker, ready};

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::Instant;

/// Longest head of a request \[bytes\].
pub(super) const HEAD_BYTES: usize = 32 * 1024;
/// Longest name of a method that is waited for \[bytes\].
const METHOD_BYTES: usize = 24;

/// Bytes that came, and have not been handed on.
#[derive(Debug, Default)]
pub(super) struct Held {
    bytes: Vec<u8>,
    /// So many of them are whole heads.
    whole: usize,
}

impl Held {
    /// Adds what came; whether there is a whole head, or what will never be one: that is for the parser to refuse.
    pub(super) fn add(&mut self, bytes: &[u8]) -> bool {
        // Between requests there may be empty lines.
        let bytes = match self.bytes.is_empty() {
            true => &bytes[empty_lines(bytes)..],
            false => bytes,
        };
        let seen = self.bytes.len().saturating_sub(2);
        self.bytes.extend_from_slice(bytes);
        if let Some(end) = end_of_heads(&self.bytes[seen..]) {
            self.whole = self.whole.max(seen + end);
        }
        // Behind whole ones as well: nobody looks at it before more comes.
        let next = &self.bytes[self.whole..];
        if is_hopeless(&next[empty_lines(next)..]) {
            self.whole = self.bytes.len();
        }
        self.whole > 0
    }

    /// Whether nothing came but the beginning of a head.
    fn is_partial(&self) -> bool {
        self.whole == 0 && !self.bytes.is_empty()
    }

    /// Holds nothing back: it is no head.
    fn release(&mut self) {
        self.whole = self.bytes.len();
    }

    /// Moves whole heads to a buffer, as far as it has room.
    fn give(&mut self, buffer: &mut ReadBuf<'_>) {
        let count = self.whole.min(buffer.remaining());
        buffer.put_slice(&self.bytes[..count]);
        self.whole -= count;
        let count = match self.whole {
            0 => count + empty_lines(&self.bytes[count..]),
            _ => count,
        };
        self.bytes.drain(..count);
    }

    /// Everything, behind what was handed on and came back.
    pub(super) fn behind(self, returned: &[u8]) -> Self {
        let mut all = Self::default();
        all.add(returned);
        all.add(&self.bytes);
        all
    }
}

/// Bytes of the empty lines that come first.
fn empty_lines(bytes: &[u8]) -> usize {
    let begin = bytes.iter().position(|byte| !b"\r\n".contains(byte));
    begin.unwrap_or(bytes.len())
}

/// Where the last head ends of which the end is there.
fn end_of_heads(bytes: &[u8]) -> Option<usize> {
    let blank = |end: &usize| {
        let before = &bytes[..*end];
        before.ends_with(b"\n\r\n") || before.ends_with(b"\n\n")
    };
    (2..=bytes.len()).rev().find(blank)
}

/// Whether no head can begin like this, so that there is nothing to wait for.
fn is_hopeless(bytes: &[u8]) -> bool {
    let method = bytes.iter().position(|byte| *byte == b' ');
    let method = &bytes[..method.unwrap_or(bytes.len())];
    let letters = |byte: &u8| byte.is_ascii_alphanumeric() || b"!#$%&'*+-.^_`|~".contains(byte);
    if bytes.len() > HEAD_BYTES || method.len() > METHOD_BYTES || !method.iter().all(letters) {
        return true;
    }
    let line = bytes.iter().position(|byte| *byte == b'\n');
    let of_http = |line: &[u8]| line.windows(6).any(|part| part == b" HTTP/");
    line.is_some_and(|end| !of_http(&bytes[..end]))
}

/// What a connection is doing.
#[derive(Debug)]
pub(super) struct Flow(Mutex<State>);

#[derive(Debug)]
struct State {
    /// Answers that are not sent yet.
    under_way: usize,
    /// Whether it takes no more of an answer for now.
    is_full: bool,
    /// Whether the next head has begun.
    has_begun: bool,
    /// Whether a request came with a body: what follows is no head, and the connection ends with the answer.
    has_body: bool,
    /// Who reads on once answers are sent.
    reader: Option<Waker>,
    /// When it last took something.
    written: Instant,
}

impl Flow {
    fn state(&self) -> MutexGuard<'_, State> {
        // Nothing is left half-changed by a panic elsewhere.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Counts an answer, until it is dropped.
    pub(super) fn answer(self: &Arc<Self>) -> UnderWay {
        self.state().under_way += 1;
        UnderWay(self.clone())
    }

    /// Whether there is nothing to do until the rest of a head comes.
    pub(super) fn waits(&self) -> bool {
        let state = self.state();
        state.has_begun && !state.has_body && state.under_way == 0 && !state.is_full
    }

    /// Notes that what comes from now on is a body.
    pub(super) fn body_comes(&self) {
        self.state().has_body = true;
    }

    /// When the last answer was taken; when it began, if there was none.
    pub(super) fn written(&self) -> Instant {
        self.state().written
    }
}

/// An answer under way.
#[derive(Debug)]
pub(super) struct UnderWay(Arc<Flow>);

impl Drop for UnderWay {
    fn drop(&mut self) {
        let mut state = self.0.state();
        state.under_way -= 1;
        if state.under_way == 0
            && let Some(reader) = state.reader.take()
        {
            reader.wake();
        }
    }
}

/// A stream whose reader sees whole heads.
#[derive(Debug)]
pub(super) struct Heads<S> {
    stream: S,
    held: Held,
    flow: Arc<Flow>,
}

impl<S> Heads<S> {
    /// Of a stream, behind bytes that came already.
    pub(super) fn new(stream: S, held: Held) -> Self {
        let state = State {
            under_way: 0,
            is_full: false,
            has_begun: false,
            has_body: false,
            reader: None,
            written: Instant::now(),
        };
        Self {
            stream,
            held,
            flow: Arc::new(Flow(Mutex::new(state))),
        }
    }

    pub(super) fn flow(&self) -> &Arc<Flow> {
        &self.flow
    }

    /// The stream, and what came and was not handed on.
    pub(super) fn into_parts(self) -> (S, Held) {
        (self.stream, self.held)
    }

    /// What becomes of an attempt to write.
    fn wrote(&self, written: Poll<io::Result<usize>>) -> Poll<io::Result<usize>> {
        let mut state = self.flow.state();
        state.is_full = written.is_pending();
        if written.is_ready() {
            state.written = Instant::now();
        }
        written
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for Heads<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let this = &mut *self;
        let has_body = this.flow.state().has_body;
        if has_body {
            this.held.release();
        }
        while this.held.whole == 0 {
            if this.held.is_partial() {
                let mut state = this.flow.state();
                state.has_begun = true;
                // More of it is not read before it can be answered.
                if state.under_way > 0 {
                    state.reader = Some(cx.waker().clone());
                    return Poll::Pending;
                }
            }
            let mut space = [0; 2048];
            let mut read = ReadBuf::new(&mut space);
            ready!(Pin::new(&mut this.stream).poll_read(cx, &mut read))?;
            if read.filled().is_empty() {
                return Poll::Ready(Ok(()));
            }
            this.held.add(read.filled());
            if has_body {
                this.held.release();
            }
        }
        this.held.give(buffer);
        this.flow.state().has_begun = this.held.is_partial();
        Poll::Ready(Ok(()))
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Heads<S> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write(cx, bytes);
        self.wrote(written)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bytes: &[IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write_vectored(cx, bytes);
        self.wrote(written)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}

/// Requests as they come in, in pieces, to a parser with little room: it sees the same whole heads however they come, until
/// something comes that is none. The first byte chooses the pieces.
#[cfg(any(test, fuzzing))]
pub(crate) fn fuzz(bytes: &[u8]) {
    use crate::fuzz_targets::pieces::pieces;

    /// Heads without what is between them, what is left, and whether that may become one.
    fn heads(mut rest: &[u8]) -> (Vec<u8>, &[u8], bool) {
        let mut heads = Vec::new();
        loop {
            rest = &rest[empty_lines(rest)..];
            let is_end =
                |end: &usize| rest[..*end].ends_with(b"\n\r\n") || rest[..*end].ends_with(b"\n\n");
            let end = (2..=rest.len()).find(is_end);
            let (next, after) = rest.split_at(end.unwrap_or(rest.len()));
            if next.len() > HEAD_BYTES || is_hopeless(next) {
                return (heads, rest, false);
            }
            if end.is_none() {
                return (heads, rest, true);
            }
            heads.extend_from_slice(next);
            rest = after;
        }
    }
    let Some((&choice, bytes)) = bytes.split_first() else {
        return;
    };
    let (want, rest, goes_on) = heads(bytes);
    let room = usize::from(choice) + 1;
    for (pieces, room) in [(vec![bytes], 8192), (pieces(choice, bytes), room)] {
        let (mut held, mut seen) = (Held::default(), Vec::new());
        let mut space = vec![0; room];
        // So much is read at a time.
        for piece in pieces.iter().flat_map(|piece| piece.chunks(2048)) {
            held.add(piece);
            while held.whole > 0 {
                let mut buffer = ReadBuf::new(&mut space);
                held.give(&mut buffer);
                seen.extend_from_slice(buffer.filled());
            }
            let most = held.bytes.len();
            assert!(most <= HEAD_BYTES, "{most} bytes are held");
        }
        let (seen, left, whole) = heads(&seen);
        assert_eq!(seen, want);
        // What may become a head is held, all of it; what is none is not waited for.
        assert_eq!(whole, goes_on);
        if goes_on {
            assert_eq!((left, &held.bytes[..]), (&[][..], rest));
        }
    }
    // What a parser gives back comes first.
    let mut held = Held::default();
    held.add(bytes);
    let mut space = vec![0; room];
    let mut buffer = ReadBuf::new(&mut space);
    held.give(&mut buffer);
    let all = [buffer.filled(), &held.bytes].concat();
    assert_eq!(held.behind(buffer.filled()).bytes, all);
}

#[cfg(test)]
mod tests {
    use std::pin::pin;

    use futures::FutureExt as _;
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _, duplex};

    use super::*;

    const HEAD: &[u8] = b"GET /a HTTP/1.1\r\nHost: b\r\n\r\n";

    fn run(test: impl Future<Output = ()>) {
        let runtime = tokio::runtime::Builder::new_current_thread();
        { runtime }.enable_time().build().unwrap().block_on(test);
    }

    #[test]
    fn heads_are_whole_at_their_blank_line_however_they_come() {
        for (head, lines) in [(HEAD, "\r\n"), (b"GET /a HTTP/1.1\nHost: b\n\n", "\n")] {
            for step in 1..head.len() {
                let mut held = Held::default();
                let mut whole = 0;
                for (n, part) in head.chunks(step).enumerate() {
                    assert_eq!(whole, 0, "{lines:?} in steps of {step}");
                    whole += usize::from(held.add(part)) * (n + 1);
                }
                assert_eq!(whole, head.len().div_ceil(step));
                assert!(!held.is_partial());
            }
        }
        // Two, and the beginning of a third, behind empty lines.
        let mut held = Held::default();
        assert!(!held.add(b"\r\n\r\n"));
        assert!(held.add(&[b"\r\n", HEAD, HEAD, b"GE"].concat()));
        assert_eq!(
            (held.whole, held.bytes.len()),
            (2 * HEAD.len(), 2 * HEAD.len() + 2)
        );
    }

    #[test]
    fn what_will_never_be_a_head_is_not_waited_for() {
        for nonsense in [
            &b"\x16\x03\x01\x02"[..],
            b"GET\x00/",
            b"PRI\t",
            b"hello\r\n",
            b"GET /index.html\r\n",
            b"aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa",
        ] {
            assert!(Held::default().add(nonsense), "{nonsense:?}");
        }
        // Nor behind one, where nothing more may come.
        let mut behind = Held::default();
        assert!(behind.add(&[HEAD, b"\x16\x03\x01"].concat()));
        assert_eq!(behind.whole, HEAD.len() + 3);
        let mut long = b"GET / HTTP/1.1\r\nX: ".to_vec();
        assert!(!Held::default().add(&long));
        long.resize(HEAD_BYTES + 1, b'y');
        assert!(Held::default().add(&long));
    }

    #[test]
    fn readers_see_whole_heads_and_the_rest_is_held() {
        run(async {
            let (mut client, server) = duplex(1000);
            let mut heads = Heads::new(server, Held::default());
            let flow = heads.flow().clone();
            let mut buffer = [0; 500];
            client.write_all(&HEAD[..9]).await.unwrap();
            assert!(heads.read(&mut buffer).now_or_never().is_none());
            assert!(flow.waits());
            client
                .write_all(&[&HEAD[9..], b"GET /b"].concat())
                .await
                .unwrap();
            assert_eq!(heads.read(&mut buffer).await.unwrap(), HEAD.len());
            assert_eq!(&buffer[..HEAD.len()], HEAD);
            assert!(flow.waits());
            // While there is an answer under way, nobody reads on; then whoever would have is woken.
            let answer = flow.answer();
            assert!(!flow.waits());
            client.write_all(b" HTTP/1.1\r\n\r\n").await.unwrap();
            {
                let mut read = pin!(heads.read(&mut buffer));
                assert!(futures::poll!(&mut read).is_pending());
                drop(answer);
                assert_eq!(read.await.unwrap(), b"GET /b HTTP/1.1\r\n\r\n".len());
            }
            assert!(!flow.waits());
            drop(client);
            assert_eq!(heads.read(&mut buffer).await.unwrap(), 0);
        });
    }

    #[test]
    fn what_was_handed_on_and_comes_back_is_first() {
        run(async {
            let (mut client, server) = duplex(1000);
            let mut heads = Heads::new(server, Held::default());
            client.write_all(&[HEAD, b"GET /c"].concat()).await.unwrap();
            let mut buffer = [0; 500];
            let count = heads.read(&mut buffer).await.unwrap();
            let (_, held) = heads.into_parts();
            assert!(held.is_partial());
            let mut all = held.behind(&buffer[..count]);
            assert_eq!(all.bytes, [HEAD, b"GET /c"].concat());
            assert_eq!(all.whole, HEAD.len());
            assert!(all.add(b" HTTP/1.1\r\n\r\n"));
        });
    }
}
