//! The object store is away when the program starts.

use std::io::{Read, Write};
use std::net::TcpListener;

use super::server_away::{Program, says, text};
use super::simulate;

/// It is waited for; what it says once it is there counts at once.
#[test]
fn a_store_that_is_away_is_waited_for_and_one_that_refuses_is_not() {
    let folder = tempfile::tempdir().unwrap();
    let acquisition = folder.path().join("acquisition");
    let catalog = folder.path().join("catalog.sqlite");
    simulate(&acquisition, "150,130,12");
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    // Nobody listens there for now.
    drop(listener);
    let endpoint = format!("http://{address}");
    let environment = [
        ("AWS_ENDPOINT_URL", &*endpoint),
        ("AWS_ACCESS_KEY_ID", "somebody"),
        ("AWS_SECRET_ACCESS_KEY", "secret"),
        ("AWS_REGION", "here"),
    ];
    let ingest = [
        "ingest",
        "--once",
        text(&acquisition),
        "s3://bucket/archive",
        "--catalog",
        text(&catalog),
    ];
    let ingest = Program::start_with(&ingest, &environment);
    says(&ingest.stderr, "trying again until it can be used");
    let listener = TcpListener::bind(address).unwrap();
    std::thread::spawn(move || {
        for connection in listener.incoming() {
            let mut connection = connection.unwrap();
            let _ = connection.read(&mut [0; 4096]);
            let _ = connection.write_all(
                b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\nConnection: close\r\n\r\n",
            );
        }
    });
    says(&ingest.stderr, "access is denied");
    ingest.ends_with(1);
    assert!(!catalog.exists());
}
