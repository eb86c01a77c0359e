//! What the keys of the full-screen view do. Pure: a key goes in, what is to be done comes out.

use protocol::{Action, CarName, ParamsAction, RelocalizeAction};
use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyModifiers};

/// What the person at the terminal has chosen.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct Choice {
    /// The selected car, by its place in the list.
    pub(super) car: usize,
    /// Open while a set is being chosen: which one the cursor is on.
    pub(super) sets: Option<usize>,
    /// The help is open.
    pub(super) help: bool,
}

/// What there is to choose from.
#[derive(Debug, Clone, Copy)]
pub(super) struct Offer<'a> {
    pub(super) cars: &'a [CarName],
    /// Sets on the selected car.
    pub(super) sets: &'a [String],
}

/// What a key asks for.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Wish {
    Nothing,
    Quit,
    Acknowledge,
    /// Something for the selected car to do.
    Do(Action),
}

impl Choice {
    /// Sets chosen with a capital letter fall back after this time unless confirmed [ms].
    pub(super) const TRIAL_MS: u32 = 60_000;

    /// Takes a key.
    pub(super) fn press(&mut self, key: KeyEvent, offer: Offer<'_>) -> Wish {
        self.car = self.car.min(offer.cars.len().saturating_sub(1));
        if key.code == KeyCode::Char('c') && key.modifiers.contains(KeyModifiers::CONTROL) {
            return Wish::Quit;
        }
        if self.help {
            self.help = false;
            return Wish::Nothing;
        }
        match self.sets {
            Some(at) => self.choose_set(at, key.code, offer.sets),
            None => self.act(key.code, offer),
        }
    }

    fn choose_set(&mut self, at: usize, key: KeyCode, sets: &[String]) -> Wish {
        let chosen = |revert_after_ms| {
            let name = sets.get(at)?.clone();
            Some(Wish::Do(Action::Params(ParamsAction::Select {
                name,
                revert_after_ms,
            })))
        };
        let wish = match key {
            KeyCode::Down | KeyCode::Char('j') => {
                self.sets = Some((at + 1).min(sets.len().saturating_sub(1)));
                return Wish::Nothing;
            }
            KeyCode::Up | KeyCode::Char('k') => {
                self.sets = Some(at.saturating_sub(1));
                return Wish::Nothing;
            }
            KeyCode::Enter => chosen(None),
            KeyCode::Char('t') => chosen(Some(Self::TRIAL_MS)),
            KeyCode::Char('w') => sets.get(at).map(|name| {
                let name = Some(name.clone());
                Wish::Do(Action::Params(ParamsAction::Shadow { name }))
            }),
            _ => None,
        };
        self.sets = None;
        wish.unwrap_or(Wish::Nothing)
    }

    fn act(&mut self, key: KeyCode, offer: Offer<'_>) -> Wish {
        match key {
            KeyCode::Down | KeyCode::Char('j') => {
                self.car = (self.car + 1).min(offer.cars.len().saturating_sub(1));
            }
            KeyCode::Up | KeyCode::Char('k') => self.car = self.car.saturating_sub(1),
            KeyCode::Char(digit @ '1'..='9') => {
                let at = digit as usize - '1' as usize;
                if at < offer.cars.len() {
                    self.car = at;
                }
            }
            KeyCode::Char('s') if !offer.sets.is_empty() => self.sets = Some(0),
            KeyCode::Char('?') => self.help = true,
            KeyCode::Char('a') => return Wish::Acknowledge,
            KeyCode::Char('q') | KeyCode::Esc => return Wish::Quit,
            // With Shift, for these take effect at once.
            KeyCode::Char('C') => return Wish::Do(Action::Params(ParamsAction::Confirm)),
            KeyCode::Char('R') => return Wish::Do(Action::Params(ParamsAction::Revert)),
            KeyCode::Char('W') => return Wish::Do(Action::Params(ParamsAction::Shadow { name: None })),
            KeyCode::Char('G') => return Wish::Do(Action::Relocalize(RelocalizeAction::Search)),
            _ => {}
        }
        Wish::Nothing
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

    fn press(choice: &mut Choice, code: KeyCode) -> Wish {
        let (cars, sets) = (cars(), ["hq".to_owned(), "lq".to_owned()]);
        let offer = Offer {
            cars: &cars,
            sets: &sets,
        };
        choice.press(KeyEvent::new(code, KeyModifiers::NONE), offer)
    }

    #[test]
    fn a_set_is_chosen_in_a_list_and_escape_leaves_it() {
        let mut choice = Choice::default();
        assert_eq!(press(&mut choice, KeyCode::Char('s')), Wish::Nothing);
        press(&mut choice, KeyCode::Down);
        press(&mut choice, KeyCode::Down);
        let select = |revert_after_ms| {
            let name = "lq".to_owned();
            Wish::Do(Action::Params(ParamsAction::Select {
                name,
                revert_after_ms,
            }))
        };
        assert_eq!(press(&mut choice, KeyCode::Enter), select(None));
        assert_eq!(choice.sets, None);
        press(&mut choice, KeyCode::Char('s'));
        press(&mut choice, KeyCode::Down);
        assert_eq!(
            press(&mut choice, KeyCode::Char('t')),
            select(Some(Choice::TRIAL_MS))
        );
        press(&mut choice, KeyCode::Char('s'));
        assert_eq!(press(&mut choice, KeyCode::Esc), Wish::Nothing);
        assert_eq!(press(&mut choice, KeyCode::Esc), Wish::Quit);
    }

    #[test]
    fn the_cursor_stays_on_the_list() {
        let mut choice = Choice {
            car: 7,
            ..Choice::default()
        };
        press(&mut choice, KeyCode::Up);
        assert_eq!(choice.car, 0);
        for _ in 0..5 {
            press(&mut choice, KeyCode::Down);
        }
        assert_eq!(choice.car, 1);
        press(&mut choice, KeyCode::Char('9'));
        assert_eq!(choice.car, 1);
        let none = Offer { cars: &[], sets: &[] };
        for code in [KeyCode::Down, KeyCode::Up, KeyCode::Char('s'), KeyCode::Enter] {
            choice.press(KeyEvent::new(code, KeyModifiers::NONE), none);
        }
        assert_eq!(
            (choice.car, choice.sets),
            (0, None),
            "an empty list is no reason to fall over"
        );
    }
}
