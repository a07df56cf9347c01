//! The page's server: on loopback alone, answers GET alone, and only to pages of its own.

use std::collections::HashMap;
use std::convert::Infallible;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use anyhow::Context;
use axum::Router;
use axum::extract::{Query, Request, State};
use axum::http::header::{
    CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, HOST, HeaderMap, ORIGIN,
    X_CONTENT_TYPE_OPTIONS,
};
use axum::http::{HeaderValue, StatusCode};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use axum::routing::{MethodRouter, get};
use serde_json::{Value, json};
use tokio::net::TcpListener;
use tokio_stream::wrappers::IntervalStream;
use tokio_stream::{Stream, StreamExt};

use crate::catalogue::Catalogue;
use crate::curves::ReadRun;
use crate::reconstruction::RunDecoder;
use crate::{activity, evaluation, recordings, settings};

/// Pause between two looks at the folder for an open page.
const LOOK: Duration = Duration::from_secs(2);
/// Most episodes kept in memory of all runs together: 12 bytes each.
const MOST_ROWS: usize = 4_000_000;
/// Most runs whose curves are drawn over each other.
const MOST_COMPARED: usize = 12;
/// Scripts and requests of this page alone; plotly compiles its shaders' loops with eval.
const POLICY: &str = "default-src 'none'; script-src 'self' 'unsafe-eval'; \
                      style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; \
                      connect-src 'self'; base-uri 'none'; form-action 'none'; \
                      frame-ancestors 'none'";

/// Binds the port on loopback.
///
/// # Errors
/// If the port is taken.
pub(crate) async fn listen(port: u16) -> anyhow::Result<TcpListener> {
    let address = SocketAddr::from((Ipv4Addr::LOCALHOST, port));
    TcpListener::bind(address).await.with_context(|| {
        format!("cannot listen on {address}; name another port with --port, or --port 0")
    })
}

/// Serves until Ctrl-C.
///
/// # Errors
/// If the listener fails.
pub(crate) async fn serve(listener: TcpListener, catalogue: Catalogue) -> anyhow::Result<()> {
    let port = listener.local_addr()?.port();
    let served = axum::serve(listener, router(catalogue, port));
    // Open pages hold their streams open: they end with the process.
    tokio::select! {
        ended = served => ended.context("the server failed"),
        signal = tokio::signal::ctrl_c() => signal.context("cannot wait for Ctrl-C"),
    }
}

/// State that all requests share.
struct Shared {
    catalogue: Catalogue,
    runs: Mutex<HashMap<String, ReadRun>>,
    plotly: String,
    /// The decoder used last, with its run: some 20 MB.
    decoder: Mutex<Option<(String, RunDecoder)>>,
}

fn router(catalogue: Catalogue, port: u16) -> Router {
    let shared = Arc::new(Shared {
        catalogue,
        runs: Mutex::default(),
        plotly: plotly_script(),
        decoder: Mutex::default(),
    });
    Router::new()
        .route(
            "/",
            get(async || asset("text/html", include_str!("../page/index.html"))),
        )
        .route(
            "/page.css",
            get(async || asset("text/css", include_str!("../page/page.css"))),
        )
        .route(
            "/page.js",
            get(async || asset("text/javascript", include_str!("../page/page.js"))),
        )
        .route(
            "/plotly.js",
            get(async |State(shared): State<Arc<Shared>>| {
                asset("text/javascript", shared.plotly.clone())
            }),
        )
        .route("/api/runs", api(list))
        .route("/api/run", api(describe))
        .route("/api/curves", api(curves))
        .route("/api/flights", api(flights))
        .route("/api/recordings", api(list_recordings))
        .route("/api/recording", api(recording))
        .route("/api/images", api(images))
        .route("/api/reconstructions", api(reconstructions))
        .route("/api/changes", get(changes))
        .with_state(shared)
        .layer(from_fn_with_state(port, guard))
}

/// Returns the route of the requests that `make` answers.
fn api(make: Make) -> MethodRouter<Arc<Shared>> {
    get(async move |state, query| answer(state, query, make).await)
}

/// Returns plotly's script out of the HTML that its crate embeds it in.
fn plotly_script() -> String {
    let html = plotly::Plot::offline_js_sources();
    let script = html
        .split_once('>')
        .and_then(|(_, rest)| rest.split_once("</script>"));
    script
        .map(|(script, _)| script.to_owned())
        .unwrap_or_default()
}

fn asset(kind: &'static str, body: impl Into<String>) -> Response {
    let kind = format!("{kind}; charset=utf-8");
    ([(CONTENT_TYPE, kind)], body.into()).into_response()
}

/// Refuses requests that other hosts' pages sent here, by name or by script.
async fn guard(State(port): State<u16>, request: Request, next: Next) -> Response {
    if !is_own(request.headers(), port) {
        let text = "this page answers to this machine alone: open the address that skein watch \
                    printed";
        return (StatusCode::FORBIDDEN, text).into_response();
    }
    let mut response = next.run(request).await;
    let headers = response.headers_mut();
    headers.insert(CONTENT_SECURITY_POLICY, HeaderValue::from_static(POLICY));
    headers.insert(X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    headers.insert(CACHE_CONTROL, HeaderValue::from_static("no-store"));
    response
}

fn is_own(headers: &HeaderMap, port: u16) -> bool {
    let names = ["127.0.0.1", "localhost"].map(|name| format!("{name}:{port}"));
    let only = |header| {
        let mut values = headers.get_all(header).iter();
        let first = values.next();
        match values.next() {
            Some(_) => Some(""),
            None => first.map(|value| value.to_str().unwrap_or_default()),
        }
    };
    let host_is_own = only(HOST).is_some_and(|host| names.iter().any(|name| name == host));
    let is_origin = |origin: &str| {
        let host = origin.strip_prefix("http://");
        host.is_some_and(|host| names.iter().any(|name| name == host))
    };
    host_is_own && only(ORIGIN).is_none_or(is_origin)
}

type Parameters = Vec<(String, String)>;
/// Makes the answer to a request.
type Make = fn(&Shared, &Parameters) -> anyhow::Result<Content>;

/// Content of an answer.
enum Content {
    Json(Value),
    /// Images, row by row.
    Bytes(Vec<u8>),
}

impl From<Value> for Content {
    fn from(value: Value) -> Self {
        Self::Json(value)
    }
}

/// Answers a request. Whatever goes wrong is an error on the page.
async fn answer(
    State(shared): State<Arc<Shared>>,
    Query(parameters): Query<Parameters>,
    make: Make,
) -> Response {
    let made = tokio::task::spawn_blocking(move || make(&shared, &parameters)).await;
    let (status, value) = match made {
        Ok(Ok(Content::Bytes(bytes))) => {
            return ([(CONTENT_TYPE, "application/octet-stream")], bytes).into_response();
        }
        Ok(Ok(Content::Json(value))) => (StatusCode::OK, value),
        Ok(Err(error)) => (
            StatusCode::NOT_FOUND,
            json!({ "error": format!("{error:#}") }),
        ),
        Err(_) => (
            StatusCode::INTERNAL_SERVER_ERROR,
            json!({ "error": "the server failed at this request" }),
        ),
    };
    let kind = [(CONTENT_TYPE, "application/json")];
    (status, kind, value.to_string()).into_response()
}

fn list(shared: &Shared, _: &Parameters) -> anyhow::Result<Content> {
    Ok(json!({ "runs": shared.catalogue.runs() }).into())
}

/// Tells a page, as long as it is open, that the list of runs has changed.
async fn changes(
    State(shared): State<Arc<Shared>>,
) -> Sse<impl Stream<Item = Result<Event, Infallible>>> {
    let mut last = String::new();
    let looks = IntervalStream::new(tokio::time::interval(LOOK));
    let stream = looks.then(move |_| {
        let shared = Arc::clone(&shared);
        async move {
            let look = move || json!(shared.catalogue.runs()).to_string();
            tokio::task::spawn_blocking(look).await.unwrap_or_default()
        }
    });
    let changed = stream.filter_map(move |runs| {
        let is_new = runs != last && !runs.is_empty();
        is_new.then(|| {
            last.clone_from(&runs);
            Ok(Event::default().data(runs))
        })
    });
    Sse::new(changed).keep_alive(KeepAlive::default())
}

fn describe(shared: &Shared, parameters: &Parameters) -> anyhow::Result<Content> {
    let id = parameter(parameters, "run")?;
    let run = shared.find(id)?;
    let text = shared.catalogue.read_text(&run.config());
    let settings = text.and_then(|text| settings::flat(&text));
    let json = |path: PathBuf| {
        let text = shared.catalogue.read_text(&path).ok()?;
        serde_json::from_str::<Value>(&text).ok()
    };
    let problem = settings.as_ref().err().map(|error| format!("{error:#}"));
    shared.with_run(id, |read| {
        Ok(json!({
            "settings": settings.unwrap_or_default(),
            "problem": problem,
            "evaluation": json(run.evaluation_json()),
            "summary": json(run.summary_json()),
            "actors": read.actors(),
            "activity": activity::of_actors(&shared.catalogue, &run),
            "latest": read.latest(),
            "damaged_rows": read.damaged(),
        })
        .into())
    })
}

fn curves(shared: &Shared, parameters: &Parameters) -> anyhow::Result<Content> {
    let name = parameter(parameters, "curve")?;
    let mut names = Vec::new();
    let mut of_runs = serde_json::Map::new();
    let ids = parameters.iter().filter(|(key, _)| key == "run");
    for (_, id) in ids.take(MOST_COMPARED) {
        // A run that was deleted meanwhile costs no other its curve.
        let read = shared.with_run(id, |read| {
            for name in read.names() {
                if !names.contains(&name) {
                    names.push(name);
                }
            }
            Ok(json!(read.curve(name)))
        });
        let value = read.unwrap_or_else(|error| json!({ "error": format!("{error:#}") }));
        of_runs.insert(id.clone(), value);
    }
    Ok(json!({ "names": names, "curves": of_runs }).into())
}

fn flights(shared: &Shared, parameters: &Parameters) -> anyhow::Result<Content> {
    let run = shared.find(parameter(parameters, "run")?)?;
    Ok(json!({ "courses": evaluation::read(&shared.catalogue, &run)? }).into())
}

fn list_recordings(shared: &Shared, parameters: &Parameters) -> anyhow::Result<Content> {
    let run = shared.find(parameter(parameters, "run")?)?;
    Ok(json!({ "recordings": recordings::list(&shared.catalogue, &run) }).into())
}

fn recording(shared: &Shared, parameters: &Parameters) -> anyhow::Result<Content> {
    let (file, episode) = shared.recorded(parameters)?;
    Ok(recordings::flight(&file, episode)?.into())
}

fn images(shared: &Shared, parameters: &Parameters) -> anyhow::Result<Content> {
    let (file, episode) = shared.recorded(parameters)?;
    Ok(Content::Bytes(skein_recordings::images(&file, episode)?))
}

/// Returns the images that the run's decoder makes of the latent codes of an episode.
fn reconstructions(shared: &Shared, parameters: &Parameters) -> anyhow::Result<Content> {
    let id = parameter(parameters, "run")?;
    let run = shared.find(id)?;
    let mut kept = shared
        .decoder
        .lock()
        .unwrap_or_else(PoisonError::into_inner);
    let of_run = kept.take().filter(|(other, _)| other == id);
    let of_run = of_run.map(|(_, decoder)| decoder);
    let decoder = match RunDecoder::newest(of_run, &shared.catalogue, &run) {
        Ok(decoder) => decoder,
        Err(error) => return Ok(json!({ "none": format!("{error:#}") }).into()),
    };
    let (file, episode) = shared.recorded(parameters)?;
    let images = decoder.decode(&recordings::codes(&file, episode)?);
    *kept = Some((id.to_owned(), decoder));
    Ok(Content::Bytes(images?))
}

fn parameter<'a>(parameters: &'a Parameters, key: &str) -> anyhow::Result<&'a str> {
    let found = parameters.iter().find(|(name, _)| name == key);
    let (_, value) = found.with_context(|| format!("the request lacks {key}"))?;
    Ok(value)
}

fn number(parameters: &Parameters, key: &str) -> anyhow::Result<usize> {
    let value = parameter(parameters, key)?;
    value
        .parse()
        .with_context(|| format!("{key} = {value:?} is no number"))
}

impl Shared {
    /// Returns the recording and the episode in it that a request names.
    fn recorded(&self, parameters: &Parameters) -> anyhow::Result<(Vec<u8>, usize)> {
        let run = self.find(parameter(parameters, "run")?)?;
        let name = parameter(parameters, "name")?;
        let file = recordings::file(&self.catalogue, &run, name)?;
        Ok((file, number(parameters, "episode")?))
    }

    fn find(&self, id: &str) -> anyhow::Result<skein_run::RunDirectory> {
        self.catalogue
            .find(id)
            .with_context(|| format!("there is no run {id:?} in the folder any more"))
    }

    /// Reads what a run has added, and calls `look` with all of it.
    fn with_run<T>(
        &self,
        id: &str,
        look: impl FnOnce(&ReadRun) -> anyhow::Result<T>,
    ) -> anyhow::Result<T> {
        let run = self.find(id);
        // A panic elsewhere leaves counts that the next update corrects or starts again.
        let mut runs = self.runs.lock().unwrap_or_else(PoisonError::into_inner);
        if run.is_err() {
            runs.remove(id);
        }
        let run = run?;
        let others = runs.iter().filter(|(other, _)| *other != id);
        if others.map(|(_, run)| run.size()).sum::<usize>() > MOST_ROWS {
            runs.retain(|other, _| other == id);
        }
        let read = runs.entry(id.to_owned()).or_default();
        read.update(&self.catalogue, &run)
            .with_context(|| format!("cannot read the files of {id:?}"))?;
        look(read)
    }
}

#[cfg(test)]
mod tests {
    use std::io::{Read, Write};

    use super::*;

    #[test]
    fn plotly_comes_whole_out_of_its_crate() {
        let script = plotly_script();
        assert!(script.len() > 1_000_000 && script.contains("plotly.js v"));
        assert!(!script.contains("<script"));
    }

    #[test]
    fn only_requests_of_the_page_itself_are_answered() {
        let own = |pairs: &[(&'static str, &'static str)]| {
            let mut headers = HeaderMap::new();
            for (name, value) in pairs {
                headers.append(*name, HeaderValue::from_static(value));
            }
            is_own(&headers, 6080)
        };
        assert!(own(&[("host", "127.0.0.1:6080")]));
        let origin = ("origin", "http://localhost:6080");
        assert!(own(&[("host", "localhost:6080"), origin]));
        for refused in [
            &[][..],
            &[("host", "evil.example:6080")],
            &[("host", "127.0.0.1:80")],
            &[("host", "127.0.0.1:6080"), ("host", "evil.example")],
            &[
                ("host", "127.0.0.1:6080"),
                ("origin", "http://evil.example"),
            ],
            &[("host", "127.0.0.1:6080"), ("origin", "null")],
        ] {
            assert!(!own(refused), "{refused:?}");
        }
    }

    /// Serves `folder` in a thread of its own until the test ends; returns the port.
    fn serve_in_background(folder: &std::path::Path) -> u16 {
        let catalogue = Catalogue::open(folder).unwrap();
        let (send, receive) = std::sync::mpsc::channel();
        std::thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_current_thread()
                .enable_all()
                .build()
                .unwrap();
            runtime.block_on(async {
                let listener = listen(0).await.unwrap();
                send.send(listener.local_addr().unwrap().port()).unwrap();
                let port = listener.local_addr().unwrap().port();
                axum::serve(listener, router(catalogue, port))
                    .await
                    .unwrap();
            });
        });
        receive.recv().unwrap()
    }

    /// Sends `head` and returns the answer.
    fn raw(port: u16, head: &str) -> String {
        let mut stream = std::net::TcpStream::connect(("127.0.0.1", port)).unwrap();
        stream
            .set_read_timeout(Some(Duration::from_secs(20)))
            .unwrap();
        stream.write_all(head.as_bytes()).unwrap();
        let mut answer = Vec::new();
        let _ = stream.read_to_end(&mut answer);
        String::from_utf8_lossy(&answer).into_owned()
    }

    fn get(port: u16, path: &str) -> String {
        let own = format!("Host: 127.0.0.1:{port}\r\nConnection: close\r\n\r\n");
        raw(port, &format!("GET {path} HTTP/1.1\r\n{own}"))
    }

    fn status(answer: &str) -> &str {
        answer.split(' ').nth(1).unwrap_or_default()
    }

    #[test]
    fn a_page_shows_healthy_damaged_and_deleted_runs_and_changes_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        for run in ["healthy", "damaged"] {
            std::fs::create_dir(at(run)).unwrap();
        }
        std::fs::write(at("healthy/config.toml"), "[run]\nseed = 7\n").unwrap();
        let rows = "episode,epoch,policy_version,actor,level,steps,walls_passed,return,outcome\n\
                    0,0,0,3,1,12,2,0.5,collided\n";
        std::fs::write(at("healthy/episodes.csv"), rows).unwrap();
        for file in [
            "config.toml",
            "episodes.csv",
            "evaluation_trajectories.csv",
            "summary.json",
        ] {
            std::fs::write(at("damaged").join(file), b"\xff\x00[=,\n,,\n").unwrap();
        }
        std::fs::create_dir(at("damaged/tensorboard")).unwrap();
        std::fs::write(at("damaged/tensorboard/x.tfevents.1"), [0xff; 99]).unwrap();
        let port = serve_in_background(folder.path());

        let page = get(port, "/");
        assert!(page.contains("content-security-policy"), "{page}");
        assert!(get(port, "/api/runs").contains("\"healthy\""));
        let run = get(port, "/api/run?run=healthy");
        assert!(
            run.contains("\"run.seed\":\"7\"") && run.contains("\"3\":"),
            "{run}"
        );
        let flights = get(port, "/api/flights?run=damaged");
        assert_eq!(status(&flights), "404");
        assert!(flights.contains("cannot read"), "{flights}");
        assert!(get(port, "/api/run?run=damaged").contains("damaged_rows\":2"));
        std::fs::remove_dir_all(at("healthy")).unwrap();
        let gone = get(port, "/api/curves?curve=return&run=healthy&run=damaged");
        assert!(
            status(&gone) == "200" && gone.contains("there is no run"),
            "{gone}"
        );

        let own = format!("Host: 127.0.0.1:{port}\r\nConnection: close\r\n");
        let post = raw(
            port,
            &format!("POST /api/runs HTTP/1.1\r\n{own}Content-Length: 0\r\n\r\n"),
        );
        assert_eq!(status(&post), "405");
        let foreign = "GET / HTTP/1.1\r\nHost: evil.example\r\nConnection: close\r\n\r\n";
        assert_eq!(status(&raw(port, foreign)), "403");
    }

    #[test]
    fn no_request_makes_the_server_fail() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("run")).unwrap();
        std::fs::write(folder.path().join("run/config.toml"), "").unwrap();
        let port = serve_in_background(folder.path());
        let words = [
            "run", "..", "%2e%2e", "/", "%00", "?", "&", "=", "api", "run=", "curve=", "%ff",
            "curves", "flights", "é", "//", "\\", "[", "%", "+",
        ];
        let mut seed = 1u64;
        let mut next = |below: usize| {
            seed = seed
                .wrapping_mul(6364136223846793005)
                .wrapping_add(1442695040888963407);
            (seed >> 33) as usize % below
        };
        for _ in 0..300 {
            let count = next(9);
            let parts: String = (0..count).map(|_| words[next(words.len())]).collect();
            let path = ["/", "/api/run?run=", "/api/curves?", "/api/flights?"][next(4)];
            let answer = get(port, &format!("{path}{parts}"));
            assert!(!status(&answer).starts_with('5'), "{path}{parts}: {answer}");
        }
        assert_eq!(status(&get(port, "/")), "200");
    }
}
