"""An S3 server on loopback, and what stands between it and its clients: a proxy that loses, delays and refuses.

Run by itself, it serves tests in other languages: prints its address, serves until its input ends, and prints how often
each fault happened and the parts of uploads that are left. `busy=0.1` among its arguments has a tenth of the requests meet that
fault. An object called `part-lost` meets that one when its first part is sent, and others likewise.
"""

import contextlib
import http.client
import http.server
import json
import logging
import random
import socket
import struct
import sys
import threading
import time
from collections import Counter
from urllib.parse import parse_qs, urlsplit
from xml.etree import ElementTree

from botocore.auth import S3SigV4Auth
from botocore.awsrequest import AWSRequest
from botocore.credentials import Credentials
from moto.server import ThreadedMotoServer

BUCKET = "lab"
# Whoever asks may read it, and nothing else.
PUBLIC = "public"
KEY = ("id", "secret")


class Store:
    """moto's server, which wants requests signed, but checks no signature."""

    SIGNED = {"Authorization": "AWS4-HMAC-SHA256 Credential=id/20260101/us-east-1/s3/aws4_request, "
                               "SignedHeaders=host, Signature=0"}

    def __init__(self):
        logging.getLogger("werkzeug").setLevel(logging.ERROR)
        self.server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
        self.server.start()
        self.host, self.port = self.server.get_host_and_port()
        for bucket in [BUCKET, PUBLIC]:
            self.request("PUT", f"/{bucket}")

    def request(self, method, path, body=None):
        connection = http.client.HTTPConnection(self.host, self.port, timeout=20)
        connection.request(method, path, body, self.SIGNED)
        answer = connection.getresponse()
        return answer.status, answer.read()

    def names(self, prefix):
        """Of the objects below a prefix, without it."""
        names, more = [], ""
        while True:
            _, page = self.request("GET", f"/{BUCKET}?list-type=2&prefix={prefix}/{more}")
            page = ElementTree.fromstring(page)
            space = page.tag.removesuffix("ListBucketResult")
            names += [key.text.removeprefix(prefix + "/") for key in page.iter(space + "Key")]
            token = page.find(space + "NextContinuationToken")
            if token is None:
                return names
            more = f"&continuation-token={token.text}"

    def object(self, prefix, name):
        status, body = self.request("GET", f"/{BUCKET}/{prefix}/{name}")
        return body if status == 200 else None

    def uploads(self, prefix):
        """Numbers of the parts of each upload below a prefix that was begun and neither completed nor aborted."""
        _, listed = self.request("GET", f"/{BUCKET}?uploads")
        found = []
        for upload in elements(listed, "Upload"):
            key, number = [next(upload.iter(upload.tag.replace("Upload", name))).text for name in ("Key", "UploadId")]
            if key.startswith(prefix + "/" if prefix else ""):
                _, parts = self.request("GET", f"/{BUCKET}/{key}?uploadId={number}")
                found.append([int(part.text) for part in elements(parts, "PartNumber")])
        return found

    def put_folder(self, folder, bucket, prefix):
        for path in folder.rglob("*"):
            if path.is_file():
                status, _ = self.request("PUT", f"/{bucket}/{prefix}/{path.relative_to(folder)}", path.read_bytes())
                assert status == 200, path

    def close(self):
        self.server.stop()


def elements(xml, name):
    """Elements of a name, in whatever space they are."""
    return [element for element in ElementTree.fromstring(xml).iter() if element.tag.rpartition("}")[2] == name]


def kind_of(method, query):
    """What a request is for: a step of an upload in parts, or its method."""
    if method == "POST" and "uploads" in query:
        return "begin"
    if "uploadId" in query:
        return {"PUT": "part", "POST": "complete", "DELETE": "abort"}.get(method, method)
    return method


def refusal(method, path, headers):
    """The code with which a store that checks signatures refuses a request, if it does."""
    signed = headers.get("Authorization")
    if not signed:
        return None if path.startswith(f"/{PUBLIC}/") and method in ("GET", "HEAD") else "AccessDenied"
    said = dict(part.strip().split("=", 1) for part in signed.split(" ", 1)[1].split(","))
    key, _, region, service, _ = said["Credential"].split("/")
    if key != KEY[0]:
        return "InvalidAccessKeyId"
    names = said["SignedHeaders"].split(";")
    request = AWSRequest(method, f"http://{headers['Host']}{path}", {name: headers[name] for name in names})
    request.context["timestamp"] = headers["x-amz-date"]
    auth = S3SigV4Auth(Credentials(*KEY), service, region)
    text = auth.string_to_sign(request, auth.canonical_request(request))
    return None if auth.signature(text, request) == said["Signature"] else "SignatureDoesNotMatch"


class Proxy:
    """Forwards requests to the store, or does one of FAULTS to them.

    Three more faults are for those who end the client meanwhile: "hold" forwards nothing, and "withhold" does, but neither
    answers before `release`; "late" answers after LATE seconds.
    """

    FAULTS = ["busy", "reset", "lost", "cut", "drip"]
    LATE = 3

    def __init__(self, store, seed):
        self.random = random.Random(seed)
        self.lock = threading.Lock()
        self.faults = {}
        # Which fault befalls a request, by its kind, its object, and how many of that kind there were for it before.
        self.order = lambda kind, path, nth: None
        self.kinds = Counter()
        self.release = threading.Event()
        self.withheld = 0
        # Uploads that are over. Of these the store knows nothing, as S3's documentation has it; moto is more lenient.
        self.ended = set()
        # moto looks whether there is an object, and then writes it.
        self.conditional = threading.Lock()
        # Whether signatures are checked; whether each question is refused when it is asked for the first time.
        self.checks = False
        self.busy_at_first = False
        self.asked = Counter()
        self.answers = Counter()
        self.requests = Counter()
        self.done = Counter()
        self.latency = 0
        proxy = self

        class Handler(http.server.BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def handle_any(self):
                body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
                url = urlsplit(self.path)
                query = parse_qs(url.query, keep_blank_values=True)
                kind = kind_of(self.command, query)
                upload = query.get("uploadId", [None])[0]
                fault = proxy.next_fault(self.command, kind, url.path)
                time.sleep(proxy.latency)
                signed = self.headers.get("Authorization") is not None
                if proxy.checks:
                    refused = refusal(self.command, self.path, self.headers)
                    proxy.counted((signed, refused))
                    if refused:
                        return self.answer(403, [], f"<Error><Code>{refused}</Code></Error>".encode())
                if proxy.busy_at_first and proxy.is_first((self.command, self.path, self.headers.get("Range"))):
                    fault = "busy"
                if fault == "busy":
                    return self.answer(503, [], b"<Error><Code>SlowDown</Code></Error>")
                if fault == "denied":
                    return self.answer(403, [], b"<Error><Code>AccessDenied</Code></Error>")
                if fault == "hold":
                    proxy.release.wait()
                if fault in ("reset", "hold"):
                    return self.reset()
                if upload in proxy.ended:
                    return self.answer(404, [], b"<Error><Code>NoSuchUpload</Code></Error>", fault)
                connection = http.client.HTTPConnection(store.host, store.port, timeout=20)
                headers = {k: v for k, v in self.headers.items() if k.lower() != "connection"}
                if not signed:  # The buckets of moto's are nobody's but their owner's.
                    headers.update(store.SIGNED)
                with proxy.conditional if self.headers.get("If-None-Match") else contextlib.nullcontext():
                    connection.request(self.command, self.path, body, headers)
                    answer = connection.getresponse()
                    content = answer.read()
                connection.close()
                if kind in ("complete", "abort") and answer.status < 300:
                    proxy.ended.add(upload)
                if fault == "late":
                    time.sleep(proxy.LATE)
                if fault == "withhold":
                    proxy.withheld += 1
                    proxy.release.wait()
                if fault in ("lost", "withhold"):  # The store did it; nobody hears of it.
                    return self.reset()
                keep = [(k, v) for k, v in answer.getheaders()
                        if k.lower() not in ("connection", "transfer-encoding", "content-length")]
                if self.command == "HEAD":
                    keep.append(("Content-Length", answer.getheader("Content-Length", "0")))
                self.answer(answer.status, keep, content, fault)

            do_GET = do_PUT = do_POST = do_HEAD = do_DELETE = handle_any

            def answer(self, status, headers, content, fault=None):
                self.send_response_only(status)
                for name, value in headers:
                    self.send_header(name, value)
                if self.command != "HEAD":
                    self.send_header("Content-Length", str(len(content)))
                self.end_headers()
                if self.command == "HEAD":
                    return
                if fault == "cut":
                    self.wfile.write(content[: len(content) // 2])
                    self.reset()
                elif fault == "drip":
                    try:
                        for at in range(len(content)):
                            self.wfile.write(content[at : at + 1])
                            self.wfile.flush()
                            time.sleep(0.2)
                    except OSError:
                        pass  # The client had enough.
                    self.close_connection = True
                else:
                    self.wfile.write(content)

            def reset(self):
                self.wfile.flush()
                self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                self.connection.close()
                self.close_connection = True

            def log_message(self, *_):
                pass

        class Server(http.server.ThreadingHTTPServer):
            daemon_threads = True

            def handle_error(self, *_):
                pass  # Connections that were reset.

        self.server = Server(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def next_fault(self, method, kind, path):
        with self.lock:
            self.requests[method] += 1
            nth = self.kinds[kind, path]
            self.kinds[kind, path] += 1
            if ordered := self.order(kind, path, nth):
                self.done[ordered] += 1
                self.done[kind, ordered] += 1
                return ordered
            drawn = self.random.random()
            for fault, share in self.faults.items():
                drawn -= share
                if drawn < 0:
                    self.done[fault] += 1
                    return fault
            return None

    def is_first(self, question):
        with self.lock:
            self.asked[question] += 1
            return self.asked[question] == 1

    def counted(self, answer):
        with self.lock:
            self.answers[answer] += 1

    def close(self):
        self.release.set()
        self.server.shutdown()
        self.server.server_close()


def fault_in_name(kind, path, nth):
    """The fault that an object's name asks for."""
    step, _, fault = path.rpartition("/")[2].partition("-")
    return fault if kind == step and nth == 0 else None


def main():
    store = Store()
    proxy = Proxy(store, time.time_ns())
    proxy.faults = {fault: float(share) for fault, share in (argument.split("=") for argument in sys.argv[1:])}
    proxy.order = fault_in_name
    print(proxy.url, flush=True)
    sys.stdin.read()
    print(json.dumps({"faults": {name: n for name, n in proxy.done.items() if isinstance(name, str)},
                      "uploads": store.uploads("")}), flush=True)


if __name__ == "__main__":
    main()
