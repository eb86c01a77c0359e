//! What the recorders at the pit wall do. Each program that records says so once a second, as JSON, so that every pit wall on the
//! network shows it.

use std::collections::BTreeMap;
use std::fmt;
use std::time::{Duration, Instant};

use protocol::plain_text;
use serde::{Deserialize, Serialize};
use zenoh::sample::Sample;

use super::error::ConnectionError;

/// The key of the news. No car has such a name.
const KEY: &str = "synpf/v1/_pitwall/recorder";
/// Longest news \[bytes\].
const MAX_LEN: usize = 4096;
/// Longest text in them that is kept \[characters\].
const MAX_TEXT: usize = 300;
/// A recorder that says nothing for this long may have died.
const SILENT: Duration = Duration::from_secs(5);
/// After this time it is forgotten.
const FORGOTTEN: Duration = Duration::from_mins(10);
/// Most recorders that are shown.
const MOST: usize = 8;

/// What a recorder does.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct RecorderNews {
    /// The program that it belongs to.
    pub(crate) program: String,
    /// The machine.
    pub host: String,
    /// The file.
    pub file: String,
    /// Time recorded so far \[s\].
    pub seconds: f64,
    /// Bytes in the file.
    pub bytes: u64,
    /// Messages that were sent and are not in the file.
    pub missing: u64,
    /// Why it has failed; None while it has not.
    pub error: Option<String>,
    /// True when it records no longer.
    pub ended: bool,
}

/// A recorder as a pit wall shows it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RecorderView {
    /// What it said last.
    #[serde(flatten)]
    pub news: RecorderNews,
    /// How long ago that was, if it should have said something since \[s\].
    pub silent_s: Option<f64>,
}

impl RecorderView {
    /// False for one that has failed or has gone silent.
    pub fn well(&self) -> bool {
        self.news.error.is_none() && self.silent_s.is_none()
    }
}

impl fmt::Display for RecorderView {
    /// `recording race.mcap on laptop: 63 s, 12.3 MB, nothing missing`
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let RecorderNews {
            host,
            file,
            seconds,
            bytes,
            missing,
            error,
            ..
        } = &self.news;
        if let Some(error) = error {
            return write!(f, "RECORDING FAILED on {host}: {error}");
        }
        if let Some(silent_s) = self.silent_s {
            return write!(f, "RECORDER SILENT for {silent_s:.0} s: {file} on {host}");
        }
        write!(
            f,
            "recording {file} on {host}: {seconds:.0} s, {:.1} MB, ",
            *bytes as f64 / 1e6
        )?;
        match missing {
            0 => f.write_str("nothing missing"),
            missing => write!(f, "{missing} MISSING"),
        }
    }
}

/// The recorders of all pit walls.
#[derive(Debug, Default)]
pub(crate) struct Recorders(BTreeMap<String, (Instant, RecorderNews)>);

impl Recorders {
    /// Notes news. Returns why the recorder has failed, if that is new.
    pub(crate) fn hear(&mut self, mut news: RecorderNews, now: Instant) -> Option<String> {
        self.0
            .retain(|_, (at, _)| now.saturating_duration_since(*at) < FORGOTTEN);
        for text in [&mut news.host, &mut news.file]
            .into_iter()
            .chain(news.error.as_mut())
        {
            *text = plain_text(text).chars().take(MAX_TEXT).collect();
        }
        // One that has failed is shown until it records again.
        if news.ended && news.error.is_none() {
            self.0.remove(&news.program);
            return None;
        }
        if self.0.len() >= MOST && !self.0.contains_key(&news.program) {
            return None;
        }
        let failure = news.error.clone();
        let before = self.0.insert(news.program.clone(), (now, news));
        failure.filter(|_| before.is_none_or(|(_, before)| before.error.is_none()))
    }

    /// What is to be shown.
    pub(crate) fn view(&self, now: Instant) -> Vec<RecorderView> {
        let view = |(at, news): &(Instant, RecorderNews)| {
            let silent = now.saturating_duration_since(*at);
            RecorderView {
                news: news.clone(),
                silent_s: (silent > SILENT && !news.ended).then_some(silent.as_secs_f64()),
            }
        };
        let mut views: Vec<_> = self.0.values().map(view).collect();
        views.sort_by_key(RecorderView::well);
        views
    }
}

/// Tells all programs.
pub(super) async fn tell(session: &zenoh::Session, mut news: RecorderNews) -> RecorderNews {
    news.program = session.zid().to_string();
    let Ok(json) = serde_json::to_vec(&news) else {
        return news;
    };
    if let Err(error) = session.put(KEY, json).await {
        tracing::debug!(%error, "the other pit walls do not know that this one records");
    }
    news
}

/// Calls `on_news` with the news of other programs.
pub(super) async fn watch(
    session: &zenoh::Session,
    on_news: impl Fn(RecorderNews) + Send + Sync + 'static,
) -> Result<Box<dyn Send + Sync>, ConnectionError> {
    let own = session.zid().to_string();
    let subscriber = session
        .declare_subscriber(KEY)
        .callback(move |sample: Sample| {
            let bytes = sample.payload().to_bytes();
            // Anybody can put anything here.
            if bytes.len() <= MAX_LEN
                && let Ok(news) = serde_json::from_slice::<RecorderNews>(&bytes)
                && news.program != own
            {
                on_news(news);
            }
        })
        .await;
    match subscriber {
        Ok(subscriber) => Ok(Box::new(subscriber)),
        Err(error) => Err(ConnectionError::subscribe(KEY, &error)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn news(program: &str) -> RecorderNews {
        RecorderNews {
            program: program.into(),
            host: "laptop".into(),
            file: "race.mcap".into(),
            seconds: 63.2,
            bytes: 12_340_000,
            ..RecorderNews::default()
        }
    }

    #[test]
    fn a_recorder_is_shown_until_it_ends_and_one_that_dies_is_missed() {
        let (mut recorders, begin) = (Recorders::default(), Instant::now());
        assert_eq!(recorders.hear(news("a"), begin), None);
        let text = |recorders: &Recorders, after| {
            let views = recorders.view(begin + Duration::from_secs(after));
            views.iter().map(ToString::to_string).collect::<Vec<_>>()
        };
        assert_eq!(
            text(&recorders, 1),
            ["recording race.mcap on laptop: 63 s, 12.3 MB, nothing missing"]
        );
        assert_eq!(
            text(&recorders, 7),
            ["RECORDER SILENT for 7 s: race.mcap on laptop"]
        );
        let failed = RecorderNews {
            error: Some("disk full\u{1b}[2J".into()),
            ended: true,
            ..news("b")
        };
        assert!(recorders.hear(failed.clone(), begin).is_some());
        assert_eq!(recorders.hear(failed, begin), None, "said once");
        assert!(text(&recorders, 1)[0].starts_with("RECORDING FAILED on laptop: disk full"));
        assert!(!text(&recorders, 1)[0].contains('\u{1b}'));
        let ended = RecorderNews {
            ended: true,
            ..news("a")
        };
        recorders.hear(ended, begin);
        assert_eq!(recorders.view(begin).len(), 1);
        for number in 0..100 {
            recorders.hear(news(&number.to_string()), begin);
        }
        assert_eq!(recorders.view(begin).len(), MOST);
    }
}
