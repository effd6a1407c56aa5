//! Events of a live run, for pages that connect, disconnect and reconnect.
//!
//! There is no queue per client: events are in one bounded log, and a client is a position in it. So publishing never
//! waits, a slow reader costs only its socket, and a client that joins late or reconnects reads the events it missed
//! from the same log.

use crate::body::Body;
use crate::given::News;
use crate::write_timeout::{Either, either};
use hyper::body::Bytes;
use serde_json::{Value, json};
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, UNIX_EPOCH};
use tokio::sync::watch;

/// Steps kept. When they are full every second one is dropped, and from then on every second one is kept: a loss curve
/// keeps its shape and its whole length, equally dense everywhere.
const MAX_STEPS: usize = 2000;
/// Notes kept, newest ones.
const MAX_NOTES: usize = 100;
/// Longest event, bytes of JSON; a longer one is not sent. Steps have some 200.
const MAX_NEWS: usize = 16 << 10;
/// Least time between two packets to a client: faster than a person reads, slow enough for many clients.
const PACE: Duration = Duration::from_millis(50);
/// Time after which an empty line keeps the connection alive; proxies cut silent ones after about 30 s.
const HEARTBEAT: Duration = Duration::from_secs(15);
/// Milliseconds after which a browser reconnects.
const RETRY: u32 = 1000;
/// In place of the newest number: there will be no more.
const CLOSED: u64 = u64::MAX;

#[derive(Clone, Debug)]
struct Entry {
    id: u64,
    /// Number of earlier events of its kind; only steps need it.
    ordinal: u64,
    line: Arc<str>,
}

#[derive(Debug, Default)]
struct Log {
    /// Number of the newest entry; the first is 1.
    newest: u64,
    steps: VecDeque<Entry>,
    /// Of every n steps one is kept, and the newest in addition: a power of two; 0 represents 1.
    stride: u64,
    /// Steps published.
    count: u64,
    notes: VecDeque<Entry>,
    snapshot: Option<Entry>,
    control: Option<Entry>,
    done: Option<Entry>,
}

impl Log {
    fn keep_step(&mut self, entry: Entry) {
        let stride = self.stride.max(1);
        if self.steps.back().is_some_and(|last| last.ordinal % stride != 0) {
            self.steps.pop_back();
        }
        self.steps.push_back(Entry { ordinal: self.count, ..entry });
        self.count += 1;
        if self.steps.len() > MAX_STEPS {
            self.stride = 2 * stride;
            let (stride, newest) = (self.stride, self.count - 1);
            self.steps.retain(|e| e.ordinal % stride == 0 || e.ordinal == newest);
        }
    }
}

/// The log and its waiting readers.
#[derive(Debug)]
pub(crate) struct Hub {
    /// Distinguishes this server's numbers from those of an earlier one at the same address.
    epoch: u64,
    log: Mutex<Log>,
    newest: watch::Sender<u64>,
}

impl Hub {
    pub(crate) fn new() -> Self {
        let epoch = UNIX_EPOCH.elapsed().unwrap_or_default().as_nanos() as u64;
        Self { epoch, log: Mutex::default(), newest: watch::Sender::new(0) }
    }

    pub(crate) fn publish(&self, news: &News) {
        match news {
            News::Step(value) => self.push("step", value, Log::keep_step),
            News::Note(value) => self.push("note", value, |log, entry| {
                if log.notes.len() >= MAX_NOTES {
                    log.notes.pop_front();
                }
                log.notes.push_back(entry);
            }),
            News::Control(value) => self.push("control", value, |log, entry| log.control = Some(entry)),
            News::Done(value) => self.push("done", value, |log, entry| log.done = Some(entry)),
        }
    }

    /// `kind: "snapshot"`: `version` of the scene, and the fields of `about`.
    pub(crate) fn snapshot(&self, version: u64, about: &Value) {
        let mut value = if about.is_object() { about.clone() } else { json!({}) };
        value["version"] = json!(version);
        self.push("snapshot", &value, |log, entry| log.snapshot = Some(entry));
    }

    fn push(&self, kind: &str, value: &Value, keep: impl FnOnce(&mut Log, Entry)) {
        let mut value = if value.is_object() { value.clone() } else { json!({ "value": value }) };
        value["kind"] = json!(kind);
        let line = value.to_string();
        if line.len() > MAX_NEWS {
            return;
        }
        let newest = {
            let mut log = self.lock();
            log.newest += 1;
            let entry = Entry { id: log.newest, ordinal: 0, line: line.into() };
            keep(&mut log, entry);
            log.newest
        };
        self.newest.send_if_modified(|n| {
            *n = newest.max(*n);
            *n != CLOSED
        });
    }

    /// Ends all streams, so that a server can stop.
    pub(crate) fn close(&self) {
        self.newest.send_replace(CLOSED);
    }

    /// Everything kept that is newer than `after`, oldest first.
    fn since(&self, after: u64) -> Vec<Entry> {
        let log = self.lock();
        let single = log.snapshot.iter().chain(&log.control).chain(&log.done);
        let mut entries: Vec<Entry> = single.filter(|e| e.id > after).cloned().collect();
        for list in [&log.steps, &log.notes] {
            let from = list.partition_point(|e| e.id <= after);
            entries.extend(list.range(from..).cloned());
        }
        entries.sort_by_key(|e| e.id);
        entries
    }

    /// All that is kept, as one JSON object: `{"news": [...]}`.
    pub(crate) fn json(&self) -> Bytes {
        let lines: Vec<Arc<str>> = self.since(0).into_iter().map(|e| e.line).collect();
        format!("{{\"news\":[{}]}}", lines.join(",")).into()
    }

    /// A stream of server-sent events from where a client left off (`Last-Event-ID`), or from the log's beginning.
    /// Must be called on the server's runtime.
    pub(crate) fn stream(self: &Arc<Self>, last: Option<&str>, held: impl Send + 'static) -> Body {
        let (sender, body) = Body::stream(None);
        let (hub, mut newest, mut place) = (self.clone(), self.newest.subscribe(), self.place(last));
        tokio::spawn(async move {
            let _held = held;
            let mut packet = format!("retry: {RETRY}\n\n");
            loop {
                // Marked as seen before the log is read, so that events in between are found by the next search.
                if *newest.borrow_and_update() == CLOSED {
                    return;
                }
                for entry in hub.since(place) {
                    packet += &format!("id: {:x}-{}\ndata: {}\n\n", hub.epoch, entry.id, entry.line);
                    place = entry.id;
                }
                // A slow client waits here, with one packet, until it is cut off.
                if !packet.is_empty() && sender.send(Ok(std::mem::take(&mut packet).into())).await.is_err() {
                    return;
                }
                tokio::time::sleep(PACE).await;
                let news = tokio::time::timeout(HEARTBEAT, newest.changed());
                match either(news, sender.closed()).await {
                    Either::First(Ok(Ok(()))) => {}
                    Either::First(Err(_)) => packet = ":\n\n".into(),
                    Either::First(Ok(Err(_))) | Either::Second(()) => return,
                }
            }
        });
        body
    }

    /// A client's last position; the beginning if it does not state it, or refers to another server.
    fn place(&self, last: Option<&str>) -> u64 {
        let known = last.and_then(|l| l.trim().split_once('-'));
        let known = known.filter(|(epoch, _)| u64::from_str_radix(epoch, 16) == Ok(self.epoch));
        let place = known.and_then(|(_, id)| id.parse().ok()).unwrap_or(0);
        if place > self.lock().newest { 0 } else { place }
    }

    fn lock(&self) -> MutexGuard<'_, Log> {
        self.log.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn kinds(entries: &[Entry]) -> Vec<String> {
        let kind = |e: &Entry| serde_json::from_str::<Value>(&e.line).unwrap()["kind"].as_str().unwrap().to_owned();
        entries.iter().map(kind).collect()
    }

    #[test]
    fn late_clients_get_the_whole_curve_and_only_the_newest_scene() {
        let hub = Hub::new();
        for i in 0..10 * MAX_STEPS {
            hub.publish(&News::Step(json!({"iteration": i})));
            if i % 1000 == 0 {
                hub.snapshot(i as u64, &json!({}));
                hub.publish(&News::Note(json!({"message": i})));
            }
        }
        hub.publish(&News::Done(json!({})));
        let all = hub.since(0);
        let count = |kind: &str| kinds(&all).iter().filter(|k| *k == kind).count();
        assert!((MAX_STEPS / 2..=MAX_STEPS).contains(&count("step")), "{}", count("step"));
        assert_eq!((count("snapshot"), count("done"), count("note")), (1, 1, 20));
        assert!(all.windows(2).all(|w| w[0].id < w[1].id));
        let first: Value = serde_json::from_str(&all[0].line).unwrap();
        assert_eq!(first["iteration"], 0, "the curve begins at its beginning");
        let iteration = |e: &Entry| serde_json::from_str::<Value>(&e.line).unwrap()["iteration"].as_u64();
        let steps: Vec<u64> = all.iter().filter_map(iteration).collect();
        assert!(steps.windows(2).all(|w| w[1] - w[0] <= 16), "no stretch of it is missing");
        assert_eq!(steps.last(), Some(&(10 * MAX_STEPS as u64 - 1)), "it ends with the newest");
        let json: Value = serde_json::from_slice(&hub.json()).unwrap();
        assert_eq!(json["news"].as_array().unwrap().len(), all.len());
    }

    #[test]
    fn reconnecting_clients_get_new_events() {
        let hub = Hub::new();
        for i in 0..5 {
            hub.publish(&News::Step(json!({ "iteration": i })));
        }
        let epoch = hub.epoch;
        assert_eq!(hub.place(Some(&format!("{epoch:x}-3"))), 3);
        assert_eq!(hub.since(3).len(), 2);
        for strange in [None, Some(""), Some("3"), Some("0-3"), Some("-"), Some("zz-9999999999999999999999")] {
            assert_eq!(hub.place(strange), 0, "{strange:?}");
        }
        assert_eq!(hub.place(Some(&format!("{epoch:x}-6"))), 0, "a place that was never given out");
    }

    #[test]
    fn events_are_one_line_of_bounded_length() {
        let hub = Hub::new();
        hub.publish(&News::Note(json!({"message": "two\nlines\r\n"})));
        hub.publish(&News::Note(json!({"message": "x".repeat(MAX_NEWS)})));
        hub.publish(&News::Note(json!("bare")));
        let all = hub.since(0);
        assert_eq!(all.len(), 2);
        assert!(all.iter().all(|e| !e.line.contains(['\n', '\r'])));
    }
}
