//! What answers say besides what the library makes of them.

use std::cell::Cell;
use std::pin::Pin;
use std::time::Duration;

use object_store::ClientOptions;
use object_store::client::{
    HttpClient, HttpConnector, HttpError, HttpRequest, HttpResponse, HttpService, ReqwestConnector,
};
use reqwest::{StatusCode, header};

/// Of the newest answer to a request.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Told {
    /// For how long the store asks not to be asked (`Retry-After`).
    pub(super) wait: Option<Duration>,
    /// Whether a part of the object was sent.
    pub(super) is_part: bool,
}

tokio::task_local! {
    static TOLD: Cell<Told>;
}

/// What becomes of a request, and what its answer told.
pub(super) async fn listen<T>(request: impl Future<Output = T>) -> (T, Told) {
    let listening = async {
        let done = request.await;
        (done, TOLD.with(Cell::get))
    };
    TOLD.scope(Cell::default(), listening).await
}

/// Connects as the library does.
#[derive(Debug)]
pub(super) struct Connector;

impl HttpConnector for Connector {
    fn connect(&self, options: &ClientOptions) -> object_store::Result<HttpClient> {
        let client = ReqwestConnector::default().connect(options)?;
        Ok(HttpClient::new(Service(client)))
    }
}

#[derive(Debug)]
struct Service(HttpClient);

impl HttpService for Service {
    fn call<'a, 'b>(
        &'a self,
        request: HttpRequest,
    ) -> Pin<Box<dyn Future<Output = Result<HttpResponse, HttpError>> + Send + 'b>>
    where
        'a: 'b,
        Self: 'b,
    {
        Box::pin(async move {
            let answer = self.0.execute(request).await?;
            let wait = answer.headers().get(header::RETRY_AFTER);
            let wait = wait.and_then(|wait| wait.to_str().ok()?.trim().parse().ok());
            let told = Told {
                wait: wait.map(Duration::from_secs),
                is_part: answer.status() == StatusCode::PARTIAL_CONTENT,
            };
            // Nobody listens while the region of a bucket is looked up.
            let _ = TOLD.try_with(|cell| cell.set(told));
            Ok(answer)
        })
    }
}
