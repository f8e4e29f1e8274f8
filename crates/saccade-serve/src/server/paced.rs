//! A stream whose reader must keep a pace.

use std::future::Future;
use std::io::{self, ErrorKind, IoSlice};
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::{Sleep, sleep};

use super::limits::Limits;

/// Writing fails with [`ErrorKind::TimedOut`] when the other side takes too little of what waits
/// for it. While nothing waits there is no hurry.
#[derive(Debug)]
pub(super) struct Paced<S> {
    stream: S,
    pace: Duration,
    /// Runs since the other side was found full.
    waiting: Option<Waiting>,
}

#[derive(Debug)]
struct Waiting {
    end: Pin<Box<Sleep>>,
    taken: usize,
}

impl<S> Paced<S> {
    /// [`Limits::PACE_BYTES`] in each `pace`.
    pub(super) fn new(stream: S, pace: Duration) -> Self {
        Self {
            stream,
            pace,
            waiting: None,
        }
    }

    /// The stream.
    pub(super) fn into_inner(self) -> S {
        self.stream
    }

    /// What becomes of an attempt to write.
    fn paced(
        &mut self,
        cx: &mut Context<'_>,
        written: Poll<io::Result<usize>>,
    ) -> Poll<io::Result<usize>> {
        if let Poll::Ready(result) = written {
            if let (Ok(taken), Some(waiting)) = (&result, &mut self.waiting) {
                waiting.taken += taken;
                if waiting.taken >= Limits::PACE_BYTES {
                    self.waiting = None;
                }
            }
            return Poll::Ready(result);
        }
        let waiting = self.waiting.get_or_insert_with(|| Waiting {
            end: Box::pin(sleep(self.pace)),
            taken: 0,
        });
        ready!(waiting.end.as_mut().poll(cx));
        Poll::Ready(Err(ErrorKind::TimedOut.into()))
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for Paced<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(cx, buffer)
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Paced<S> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write(cx, bytes);
        self.paced(cx, written)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bytes: &[IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write_vectored(cx, bytes);
        self.paced(cx, written)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        // Asked for when everything was written: nothing waits any more.
        self.waiting = None;
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::io::{AsyncReadExt, AsyncWriteExt, duplex};

    const PACE: Duration = Duration::from_millis(80);

    fn run(test: impl Future<Output = ()>) {
        let runtime = tokio::runtime::Builder::new_current_thread();
        let runtime = { runtime }.enable_time().build().unwrap();
        let limited = async { tokio::time::timeout(Duration::from_secs(20), test).await };
        runtime.block_on(limited).expect("the test hangs");
    }

    #[test]
    fn a_reader_that_takes_nothing_ends_it() {
        run(async {
            let (ours, _theirs) = duplex(100);
            let error = Paced::new(ours, PACE)
                .write_all(&[0; 200])
                .await
                .unwrap_err();
            assert_eq!(error.kind(), ErrorKind::TimedOut);
        });
    }

    #[test]
    fn a_reader_that_takes_a_byte_now_and_then_ends_it_too() {
        run(async {
            let (ours, mut theirs) = duplex(100);
            let reading = async {
                while theirs.read_u8().await.is_ok() {
                    sleep(PACE / 8).await;
                }
            };
            let writing = async {
                let mut paced = Paced::new(ours, PACE);
                paced.write_all(&vec![0; 2 * Limits::PACE_BYTES]).await
            };
            let (written, ()) = tokio::join!(writing, reading);
            assert_eq!(written.unwrap_err().kind(), ErrorKind::TimedOut);
        });
    }

    #[test]
    fn a_reader_at_the_pace_gets_everything() {
        run(async {
            let length = 4 * Limits::PACE_BYTES;
            let (ours, mut theirs) = duplex(1000);
            let reading = async {
                let (mut taken, mut part) = (0, vec![0; Limits::PACE_BYTES]);
                while taken < length {
                    theirs.read_exact(&mut part).await.unwrap();
                    taken += part.len();
                    sleep(PACE / 2).await;
                }
            };
            let writing = async { Paced::new(ours, PACE).write_all(&vec![7; length]).await };
            let (written, ()) = tokio::join!(writing, reading);
            written.unwrap();
        });
    }

    #[test]
    fn between_answers_there_is_no_hurry() {
        run(async {
            let (ours, mut theirs) = duplex(100);
            let mut paced = Paced::new(ours, PACE);
            let mut answer = [0; 150];
            for _ in 0..2 {
                let (sent, read) = tokio::join!(
                    async {
                        paced.write_all(&[1; 150]).await?;
                        paced.flush().await
                    },
                    theirs.read_exact(&mut answer)
                );
                sent.unwrap();
                read.unwrap();
                sleep(2 * PACE).await;
            }
        });
    }
}
