//! The full-screen view for a terminal: all cars, one of them in detail, the log, and the parameter sets.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::Duration;

use pitwall::{CarView, FleetService, HealthSample, LogEntry, RecorderView, unix_now};
use protocol::{Action, CarName, Severity};
use ratatui::crossterm::event::{self, Event, KeyEventKind};
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::{Color, Modifier, Style, Stylize};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Block, Clear, Paragraph, Row, Sparkline, Table, TableState};
use ratatui::{DefaultTerminal, Frame};

use super::keys::{Choices, KeyAction, Selection};
use super::text;

/// The content of the screen.
#[derive(Default)]
struct Shown {
    cars: Vec<CarView>,
    /// Health of the selected car over the last two minutes.
    history: Vec<HealthSample>,
    log: Vec<LogEntry>,
    alarms: usize,
    /// The recorders of the pit walls; None before the first update.
    recorders: Option<Vec<RecorderView>>,
    selection: Selection,
    /// Outcome of the last command, and whether it succeeded; None while it runs.
    answer: Option<(Option<bool>, String)>,
}

/// Shows the cars until the user presses q.
pub(crate) async fn run(
    service: Arc<FleetService>,
    car: Option<CarName>,
    operator: String,
    period: Duration,
) -> anyhow::Result<()> {
    // Reading keys blocks, and the terminal must be restored in any case. So a separate thread owns it.
    let runtime = tokio::runtime::Handle::current();
    let leave = Arc::new(std::sync::atomic::AtomicBool::new(false));
    let stop = Guard(leave.clone());
    let work = tokio::task::spawn_blocking(move || {
        let mut terminal = ratatui::try_init()?;
        let shown = loop_until(&mut terminal, &service, car, &operator, period, &runtime, &leave);
        ratatui::try_restore()?;
        shown
    });
    let outcome = work.await?;
    drop(stop);
    outcome
}

/// Makes the thread restore the terminal when the view is dropped.
struct Guard(Arc<std::sync::atomic::AtomicBool>);

impl Drop for Guard {
    fn drop(&mut self) {
        self.0.store(true, std::sync::atomic::Ordering::Relaxed);
    }
}

fn loop_until(
    terminal: &mut DefaultTerminal,
    service: &Arc<FleetService>,
    car: Option<CarName>,
    operator: &str,
    period: Duration,
    runtime: &tokio::runtime::Handle,
    leave: &std::sync::atomic::AtomicBool,
) -> anyhow::Result<()> {
    let mut shown = Shown::default();
    let mut wanted = car;
    let (answers, answered): (Sender<_>, Receiver<_>) = channel();
    while !leave.load(std::sync::atomic::Ordering::Relaxed) {
        shown.update(service);
        if let Some(at) = wanted
            .as_ref()
            .and_then(|name| shown.cars.iter().position(|c| c.car == *name))
        {
            shown.selection.car = at;
            wanted = None;
        }
        shown.answer = answered.try_iter().last().or(shown.answer);
        terminal.draw(|frame| shown.draw(frame))?;
        if !event::poll(period)? {
            continue;
        }
        let Event::Key(key) = event::read()? else {
            continue;
        };
        if key.kind == KeyEventKind::Release {
            continue;
        }
        // An answer that was read makes room for the keys.
        shown.answer.take_if(|(done, _)| done.is_some());
        match shown.press(key) {
            KeyAction::Nothing => {}
            KeyAction::Quit => return Ok(()),
            KeyAction::Acknowledge => {
                let (service, operator) = (service.clone(), operator.to_owned());
                runtime.spawn(async move { service.acknowledge(&operator).await });
            }
            KeyAction::Do(action) => {
                if let Some(view) = shown.cars.get(shown.selection.car) {
                    shown.answer = Some((None, format!("{}: waiting for the car", view.car)));
                    let revision = view.set.as_ref().map(|set| set.revision);
                    let command = send_command(
                        service.clone(),
                        view.car.clone(),
                        operator.to_owned(),
                        revision,
                        action,
                    );
                    let answers = answers.clone();
                    runtime.spawn(async move { drop(answers.send(command.await)) });
                }
            }
        }
    }
    Ok(())
}

/// Sends a command and returns a text about its outcome.
async fn send_command(
    service: Arc<FleetService>,
    car: CarName,
    operator: String,
    revision: Option<u64>,
    action: Action,
) -> (Option<bool>, String) {
    // A change of the set refers to the revision on the screen.
    let expected = matches!(action, Action::Params(_)).then_some(revision).flatten();
    match service.client().command(&car, &operator, expected, action).await {
        Ok(verdict) => (Some(verdict.exit_code() == 0), verdict.text(&car)),
        Err(error) => (Some(false), format!("{car}: {error}")),
    }
}

impl Shown {
    const LOG: usize = 200;

    /// Updates what is shown.
    fn update(&mut self, service: &FleetService) {
        let fleet = service.fleet();
        self.cars = fleet.view(unix_now());
        self.alarms = fleet.log().alarms();
        self.recorders = Some(service.recorders());
        let from = fleet.log().last().saturating_sub(Self::LOG as u64);
        self.log = fleet.log().since(from).cloned().collect();
        // Late entries are sorted in by time.
        self.log.sort_by_key(|entry| entry.at);
        let selected = self
            .cars
            .get(self.selection.car)
            .and_then(|view| fleet.car(&view.car));
        self.history = selected
            .map(|car| car.history().copied().collect())
            .unwrap_or_default();
    }

    fn press(&mut self, key: event::KeyEvent) -> KeyAction {
        let cars: Vec<_> = self.cars.iter().map(|car| car.car.clone()).collect();
        let set = self.cars.get(self.selection.car).and_then(|car| car.set.as_ref());
        let sets = set.map(|set| set.available.clone()).unwrap_or_default();
        let choices = Choices {
            cars: &cars,
            sets: &sets,
        };
        self.selection.press(key, choices)
    }

    fn draw(&self, frame: &mut Frame<'_>) {
        let rows = self.cars.len().max(1) as u16 + 3;
        // On a small screen, the cars and their states stay and the log is hidden first.
        let height = frame.area().height;
        let cars = rows.min(height / 2);
        let log = (height / 4).min(height.saturating_sub(cars + 9));
        let areas = Layout::vertical([
            Constraint::Length(cars),
            Constraint::Fill(1),
            Constraint::Length(if log < 3 { 0 } else { log }),
            Constraint::Length(1),
        ])
        .split(frame.area());
        self.draw_cars(frame, areas[0]);
        self.draw_car(frame, areas[1]);
        self.draw_log(frame, areas[2]);
        self.draw_foot(frame, areas[3]);
        if self.selection.help {
            popup(frame, "keys", &HELP.map(str::to_owned));
        } else if let Some(at) = self.selection.sets {
            self.draw_sets(frame, at);
        }
    }

    fn draw_cars(&self, frame: &mut Frame<'_>, area: Rect) {
        // On a narrow screen, the causes matter more than numbers that are shown below.
        let wide = area.width >= WIDE;
        let keep = |column: usize| wide || [0, 1, 2, 4, 6, 8].contains(&column);
        let columns = |cells: [Line<'static>; 9]| {
            let kept = cells.into_iter().enumerate().filter(|(column, _)| keep(*column));
            Row::new(kept.map(|(_, cell)| cell))
        };
        let head = [
            "car", "state", "set", "pose/s", "age ms", "RTT ms", "missing", "lap s", "why",
        ];
        let rows = self.cars.iter().map(|car| {
            let style = style_of(&car.state);
            let set = car
                .set
                .as_ref()
                .map_or("-".to_owned(), |set| format!("{} r{}", set.name, set.revision));
            let state = format!("{} {}", shape_of(&car.state), car.state);
            let missing = car.missing;
            let quiet = if car.blind {
                Modifier::DIM
            } else {
                Modifier::empty()
            };
            columns([
                Line::from(car.car.to_string()).bold(),
                Line::styled(state, style.bold()),
                Line::from(set),
                Line::from(format!(
                    "{:.0}",
                    car.streams.get("pose").map_or(0.0, |s| s.rate_hz)
                ))
                .right_aligned(),
                Line::from(text::number(car.pose.as_ref().map(|p| p.age_s * 1e3), 0)).right_aligned(),
                Line::from(text::number(car.round_trip_s.map(|s| s * 1e3), 1)).right_aligned(),
                Line::from(missing.to_string()).right_aligned(),
                Line::from(text::number(car.last_lap_s, 2)).right_aligned(),
                Line::from(car.causes.join("; ")),
            ])
            .style(Style::new().add_modifier(quiet))
        });
        let widths = [12, 15, 16, 6, 6, 6, 7, 7].map(Constraint::Length).into_iter();
        let widths = widths.chain([Constraint::Fill(1)]).enumerate();
        let widths = widths.filter(|(column, _)| keep(*column)).map(|(_, width)| width);
        let table = Table::new(rows, widths)
            .header(columns(head.map(Line::from)).dim())
            .row_highlight_style(Style::new().reversed())
            .block(Block::bordered().title(self.title()));
        let mut state = TableState::new().with_selected(self.selection.car);
        if self.cars.is_empty() {
            let text = "no car yet; start one with car-node run ... --connect tcp/THIS-LAPTOP:7447";
            frame.render_widget(
                Paragraph::new(text).block(Block::bordered().title(self.title())),
                area,
            );
        } else {
            frame.render_stateful_widget(table, area, &mut state);
        }
    }

    /// The program, and what is recorded.
    fn title(&self) -> Line<'static> {
        let mut title = vec![Span::from(" pit wall ")];
        if let Some(recorders) = &self.recorders {
            let style = match &recorders[..] {
                [] => Style::new().dim(),
                all if all.iter().all(RecorderView::well) => Style::new().fg(Color::Green),
                _ => Style::new().fg(Color::White).bg(Color::Red).bold(),
            };
            title.push(Span::styled(format!(" {} ", text::recorders(recorders)), style));
        }
        Line::from(title)
    }

    fn draw_car(&self, frame: &mut Frame<'_>, area: Rect) {
        let Some(car) = self.cars.get(self.selection.car) else {
            return;
        };
        let block = Block::bordered()
            .title(format!(" {} ", car.car))
            .border_style(style_of(&car.state));
        let card = text::card(car);
        let room = area.width.saturating_sub(2) as usize;
        let mut lines: Vec<Line<'_>> = card
            .lines()
            .skip(1)
            .flat_map(|line| wrapped(line, room, 8))
            .map(Line::from)
            .collect();
        let since = if car.blind {
            format!(" silent for {:.1} s", car.quiet_s)
        } else {
            car.state_for_s
                .map_or_else(String::new, |s| format!(" for {s:.0} s"))
        };
        let state = format!("{} {}", shape_of(&car.state), car.state);
        lines.insert(
            0,
            Line::from(vec![
                Span::styled(state, style_of(&car.state).bold()),
                Span::from(since),
            ]),
        );
        if let Some(shadow) = &car.shadow {
            let comparison = text::comparison(shadow);
            lines.extend(wrapped(&comparison, room, 8).into_iter().map(Line::from));
        }
        // The curve gets the width that the text leaves.
        let chart = if (area.height as usize) < lines.len() + 5 {
            0
        } else {
            3
        };
        let areas = Layout::vertical([Constraint::Fill(1), Constraint::Length(chart)]).split(area);
        frame.render_widget(Paragraph::new(lines).block(block), areas[0]);
        let width = areas[1].width.saturating_sub(2) as usize;
        let percent: Vec<u64> = self
            .history
            .iter()
            .rev()
            .take(width)
            .rev()
            .map(|moment| (f64::from(moment.alignment) * 100.0).round() as u64)
            .collect();
        let title = " alignment, two points a second, 0 to 100 % ";
        let spark = Sparkline::default()
            .data(percent)
            .max(100)
            .style(style_of(&car.state))
            .block(Block::bordered().title(title));
        frame.render_widget(spark, areas[1]);
    }

    fn draw_log(&self, frame: &mut Frame<'_>, area: Rect) {
        let room = area.height.saturating_sub(2) as usize;
        let width = area.width.saturating_sub(2) as usize;
        let lines: Vec<_> = self
            .log
            .iter()
            .rev()
            .take(room)
            .flat_map(|entry| {
                let style = match entry.severity {
                    Severity::Info => Style::new(),
                    Severity::Warning => Style::new().fg(Color::Yellow),
                    Severity::Critical => Style::new().fg(Color::Red).bold(),
                };
                wrapped(&text::log_line(entry), width, 13)
                    .into_iter()
                    .map(move |part| Line::styled(part, style))
            })
            .collect();
        let mut title = vec![Span::from(" events, UTC ")];
        if self.alarms > 0 {
            let alarms = format!(" {} not acknowledged (a) ", self.alarms);
            title.push(Span::styled(
                alarms,
                Style::new().fg(Color::White).bg(Color::Red).bold(),
            ));
        }
        frame.render_widget(
            Paragraph::new(lines).block(Block::bordered().title(Line::from(title))),
            area,
        );
    }

    fn draw_foot(&self, frame: &mut Frame<'_>, area: Rect) {
        let keys = "↑↓ car  s sets  C confirm  R revert  G search  a acknowledge  ? keys  q quit";
        let foot = match &self.answer {
            None => Line::from(keys).dim(),
            Some((done, text)) => {
                let (mark, colour) = match done {
                    None => ("…", Color::Blue),
                    Some(true) => ("✓", Color::Green),
                    Some(false) => ("✗", Color::Red),
                };
                Line::styled(
                    format!("{mark} {}", text.replace('\n', " ")),
                    Style::new().fg(colour),
                )
            }
        };
        frame.render_widget(Paragraph::new(foot), area);
    }

    fn draw_sets(&self, frame: &mut Frame<'_>, at: usize) {
        let Some((car, set)) = self
            .cars
            .get(self.selection.car)
            .and_then(|car| Some((car, car.set.as_ref()?)))
        else {
            return;
        };
        let mut lines: Vec<String> = set
            .available
            .iter()
            .enumerate()
            .map(|(i, name)| {
                let cursor = if i == at { "▶" } else { " " };
                let force = if *name == set.name { " (in force)" } else { "" };
                format!("{cursor} {name}{force}")
            })
            .collect();
        lines.push(String::new());
        lines.extend(
            [
                "Enter put in force",
                "t     the same for a minute, unless confirmed",
                "w     run in the shadow",
                "Esc   leave",
            ]
            .map(str::to_owned),
        );
        popup(frame, &format!("sets of {}", car.car), &lines);
    }
}

const HELP: [&str; 11] = [
    "↑ ↓ or k j, 1 ... 9   select a car",
    "s                     choose a set: put it in force, try it for a minute,",
    "                      run it in the shadow",
    "C                     confirm the set in force: no falling back",
    "R                     revert to the set before",
    "W                     end the shadow",
    "G                     let the car search the whole map",
    "a                     acknowledge alarms",
    "q, Esc, Ctrl-C        quit",
    "",
    "any key closes this",
];

/// Width from which on the table has all columns.
const WIDE: u16 = 100;

/// Wraps a line to `width`, between fields if possible. All lines but the first are indented.
fn wrapped(line: &str, width: usize, indent: usize) -> Vec<String> {
    let mut lines = Vec::new();
    let mut rest = line.to_owned();
    loop {
        let Some((end, _)) = rest.char_indices().nth(width) else {
            lines.push(rest);
            return lines;
        };
        // Not within the indent, which would never end.
        let from = rest
            .char_indices()
            .nth(indent + 1)
            .map_or(end, |(at, _)| at.min(end));
        let found = ["  ", " "].iter().find_map(|gap| rest[from..end].rfind(gap));
        let Some(at) = found.map(|at| from + at) else {
            lines.push(rest);
            return lines;
        };
        let next = format!("{:indent$}{}", "", rest[at..].trim_start());
        rest.truncate(at);
        lines.push(rest);
        rest = next;
    }
}

/// A popup in the middle of the screen.
fn popup(frame: &mut Frame<'_>, title: &str, lines: &[String]) {
    let width = lines.iter().map(|l| l.chars().count()).max().unwrap_or(0) as u16 + 4;
    let area = frame.area();
    let size = (width.min(area.width), (lines.len() as u16 + 2).min(area.height));
    let place = Rect::new(
        (area.width - size.0) / 2,
        (area.height - size.1) / 2,
        size.0,
        size.1,
    );
    frame.render_widget(Clear, place);
    let block = Block::bordered().title(format!(" {title} ")).bold();
    frame.render_widget(Paragraph::new(lines.join("\n")).block(block), place);
}

/// Word and shape have the same meaning as the colour.
fn shape_of(state: &str) -> &'static str {
    match state {
        "LOCALIZED" => "●",
        "DEGRADED" => "▲",
        "LOST" => "✖",
        "STALE" => "■",
        "RELOCALIZING" => "↻",
        "CONVERGING" => "◐",
        "BLIND" => "□",
        "UNKNOWN" => "?",
        _ => "○",
    }
}

fn style_of(state: &str) -> Style {
    let colour = match state {
        "LOCALIZED" => Color::Green,
        "DEGRADED" => Color::Yellow,
        "LOST" | "STALE" => Color::Red,
        "RELOCALIZING" | "CONVERGING" => Color::Blue,
        _ => Color::DarkGray,
    };
    Style::new().fg(colour)
}

#[cfg(test)]
mod tests {
    use super::*;
    use pitwall::{EventPayload, Fleet, FleetEvent};
    use ratatui::Terminal;
    use ratatui::backend::TestBackend;

    fn picture(shown: &Shown, width: u16, height: u16) -> String {
        let mut terminal = Terminal::new(TestBackend::new(width, height)).expect("a screen");
        terminal.draw(|frame| shown.draw(frame)).expect("drawn");
        terminal.backend().to_string()
    }

    fn shown() -> Shown {
        let mut fleet = Fleet::default();
        for name in ["car-1", "car-2"] {
            fleet.apply(&FleetEvent {
                at: 0,
                car: name.parse().expect("a name"),
                payload: EventPayload::Appeared,
            });
        }
        fleet.tick(7_000_000_000);
        Shown {
            cars: fleet.view(7_000_000_000),
            log: fleet.log().since(0).cloned().collect(),
            alarms: fleet.log().alarms(),
            ..Shown::default()
        }
    }

    #[test]
    fn silence_is_told_in_words_with_its_length() {
        let text = picture(&shown(), 120, 30);
        for expected in [
            "□ BLIND",
            "silent for 7.0 s",
            "car-2 BLIND: nothing comes",
            "2 not acknowledged",
        ] {
            assert!(text.contains(expected), "{expected:?} is not in\n{text}");
        }
    }

    #[test]
    fn a_small_terminal_keeps_the_states_of_all_cars() {
        for (width, height) in [(70, 18), (80, 24), (60, 12)] {
            let text = picture(&shown(), width, height);
            assert!(text.contains("□ BLIND"), "{width}x{height}:\n{text}");
        }
    }

    #[test]
    fn lines_break_between_fields() {
        let line = "load    cpu 0.05 cores  update 0.12/0.24 ms  scans 40.0/s";
        assert_eq!(
            wrapped(line, 50, 8),
            [
                "load    cpu 0.05 cores  update 0.12/0.24 ms",
                "        scans 40.0/s"
            ]
        );
        assert_eq!(wrapped(line, 80, 8), [line]);
        assert_eq!(wrapped("one two", 4, 0), ["one", "two"]);
        for width in 0..60 {
            let words: Vec<_> = wrapped(line, width, 8);
            let words: Vec<_> = words.iter().flat_map(|part| part.split_whitespace()).collect();
            assert_eq!(words, line.split_whitespace().collect::<Vec<_>>(), "{width}");
        }
    }

    #[test]
    fn a_usual_terminal_tells_why_and_every_key() {
        let text = picture(&shown(), 80, 24);
        let row = text.lines().find(|row| row.contains("car-2")).expect("car-2");
        assert!(row.contains("nothing heard"), "{text}");
        assert!(text.contains("q quit"), "{text}");
    }

    #[test]
    fn any_size_can_be_drawn() {
        let mut shown = shown();
        for (sets, help) in [(None, false), (Some(3), false), (None, true)] {
            shown.selection.sets = sets;
            shown.selection.help = help;
            for (width, height) in [(1, 1), (10, 3), (40, 12), (80, 24), (250, 80)] {
                picture(&shown, width, height);
            }
        }
        picture(&Shown::default(), 80, 24);
    }
}
