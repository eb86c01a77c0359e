//! Key bindings of the full-screen view. Pure: maps a key to an action.

use protocol::{Action, CarName, ParamsAction, RelocalizeAction};
use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyModifiers};

/// The current selection.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct Selection {
    /// Index of the selected car.
    pub(super) car: usize,
    /// Index of the set under the cursor while the list of sets is open.
    pub(super) sets: Option<usize>,
    /// True while the help is open.
    pub(super) help: bool,
}

/// The choices.
#[derive(Debug, Clone, Copy)]
pub(super) struct Choices<'a> {
    pub(super) cars: &'a [CarName],
    /// Sets on the selected car.
    pub(super) sets: &'a [String],
}

/// The action of a key.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum KeyAction {
    Nothing,
    Quit,
    Acknowledge,
    /// A command for the selected car.
    Do(Action),
}

impl Selection {
    /// Sets chosen with a capital letter fall back after this time unless confirmed \[ms\].
    pub(super) const TRIAL_MS: u32 = 60_000;

    /// Handles a key.
    pub(super) fn press(&mut self, key: KeyEvent, choices: Choices<'_>) -> KeyAction {
        self.car = self.car.min(choices.cars.len().saturating_sub(1));
        if key.code == KeyCode::Char('c') && key.modifiers.contains(KeyModifiers::CONTROL) {
            return KeyAction::Quit;
        }
        if self.help {
            self.help = false;
            return KeyAction::Nothing;
        }
        match self.sets {
            Some(at) => self.choose_set(at, key.code, choices.sets),
            None => self.act(key.code, choices),
        }
    }

    fn choose_set(&mut self, at: usize, key: KeyCode, sets: &[String]) -> KeyAction {
        let chosen = |revert_after_ms| {
            let name = sets.get(at)?.clone();
            Some(KeyAction::Do(Action::Params(ParamsAction::Select {
                name,
                revert_after_ms,
            })))
        };
        let action = match key {
            KeyCode::Down | KeyCode::Char('j') => {
                self.sets = Some((at + 1).min(sets.len().saturating_sub(1)));
                return KeyAction::Nothing;
            }
            KeyCode::Up | KeyCode::Char('k') => {
                self.sets = Some(at.saturating_sub(1));
                return KeyAction::Nothing;
            }
            KeyCode::Enter => chosen(None),
            KeyCode::Char('t') => chosen(Some(Self::TRIAL_MS)),
            KeyCode::Char('w') => sets.get(at).map(|name| {
                let name = Some(name.clone());
                KeyAction::Do(Action::Params(ParamsAction::Shadow { name }))
            }),
            _ => None,
        };
        self.sets = None;
        action.unwrap_or(KeyAction::Nothing)
    }

    fn act(&mut self, key: KeyCode, choices: Choices<'_>) -> KeyAction {
        match key {
            KeyCode::Down | KeyCode::Char('j') => {
                self.car = (self.car + 1).min(choices.cars.len().saturating_sub(1));
            }
            KeyCode::Up | KeyCode::Char('k') => self.car = self.car.saturating_sub(1),
            KeyCode::Char(digit @ '1'..='9') => {
                let at = digit as usize - '1' as usize;
                if at < choices.cars.len() {
                    self.car = at;
                }
            }
            KeyCode::Char('s') if !choices.sets.is_empty() => self.sets = Some(0),
            KeyCode::Char('?') => self.help = true,
            KeyCode::Char('a') => return KeyAction::Acknowledge,
            KeyCode::Char('q') | KeyCode::Esc => return KeyAction::Quit,
            // With Shift, because these take effect at once.
            KeyCode::Char('C') => return KeyAction::Do(Action::Params(ParamsAction::Confirm)),
            KeyCode::Char('R') => return KeyAction::Do(Action::Params(ParamsAction::Revert)),
            KeyCode::Char('W') => return KeyAction::Do(Action::Params(ParamsAction::Shadow { name: None })),
            KeyCode::Char('G') => return KeyAction::Do(Action::Relocalize(RelocalizeAction::Search)),
            _ => {}
        }
        KeyAction::Nothing
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cars() -> Vec<CarName> {
        ["car-1", "car-2"]
            .map(|name| name.parse().expect("a name"))
            .into()
    }

    fn press(selection: &mut Selection, code: KeyCode) -> KeyAction {
        let (cars, sets) = (cars(), ["hq".to_owned(), "lq".to_owned()]);
        let choices = Choices {
            cars: &cars,
            sets: &sets,
        };
        selection.press(KeyEvent::new(code, KeyModifiers::NONE), choices)
    }

    #[test]
    fn a_set_is_chosen_in_a_list_and_escape_leaves_it() {
        let mut selection = Selection::default();
        assert_eq!(press(&mut selection, KeyCode::Char('s')), KeyAction::Nothing);
        press(&mut selection, KeyCode::Down);
        press(&mut selection, KeyCode::Down);
        let select = |revert_after_ms| {
            let name = "lq".to_owned();
            KeyAction::Do(Action::Params(ParamsAction::Select {
                name,
                revert_after_ms,
            }))
        };
        assert_eq!(press(&mut selection, KeyCode::Enter), select(None));
        assert_eq!(selection.sets, None);
        press(&mut selection, KeyCode::Char('s'));
        press(&mut selection, KeyCode::Down);
        assert_eq!(
            press(&mut selection, KeyCode::Char('t')),
            select(Some(Selection::TRIAL_MS))
        );
        press(&mut selection, KeyCode::Char('s'));
        assert_eq!(press(&mut selection, KeyCode::Esc), KeyAction::Nothing);
        assert_eq!(press(&mut selection, KeyCode::Esc), KeyAction::Quit);
    }

    #[test]
    fn the_cursor_stays_on_the_list() {
        let mut selection = Selection {
            car: 7,
            ..Selection::default()
        };
        press(&mut selection, KeyCode::Up);
        assert_eq!(selection.car, 0);
        for _ in 0..5 {
            press(&mut selection, KeyCode::Down);
        }
        assert_eq!(selection.car, 1);
        press(&mut selection, KeyCode::Char('9'));
        assert_eq!(selection.car, 1);
        let none = Choices { cars: &[], sets: &[] };
        for code in [KeyCode::Down, KeyCode::Up, KeyCode::Char('s'), KeyCode::Enter] {
            selection.press(KeyEvent::new(code, KeyModifiers::NONE), none);
        }
        assert_eq!(
            (selection.car, selection.sets),
            (0, None),
            "an empty list is no reason to fall over"
        );
    }
}
