//! The tables that predict ranges, built once and shared between threads and localizers.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::cddt::Cddt;
use crate::range_table::{RangeTable, TableParameters};

/// Who builds a table that a localizer needs and that is not there yet.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum TablePolicy {
    /// The localizer's own thread, at once. The results then depend on the input alone, as an offline evaluation needs it.
    #[default]
    BuildNow,
    /// Whoever takes the jobs of [`crate::TrackMap::pending_tables`], usually a worker thread. Until the table is there, the
    /// localizer marches its rays. The results then depend on when that is.
    Defer,
}

/// A table that a localizer waits for; see [`crate::TrackMap::build_table`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct TableJob(pub(crate) TableKey);

/// What a table's contents depend on, beside the map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum TableKey {
    /// The ranges in one region.
    Ranges {
        region: usize,
        parameters: TableParameters,
    },
    /// The crossings with walls on the whole map.
    Cddt,
}

/// A table of either kind.
#[derive(Debug, Clone)]
pub(crate) enum Table {
    Ranges(Arc<RangeTable>),
    Cddt(Arc<Cddt>),
}

impl Table {
    /// Memory that it takes \[bytes\].
    fn bytes(&self) -> usize {
        match self {
            Self::Ranges(table) => table.bytes(),
            Self::Cddt(table) => table.bytes(),
        }
    }
}

/// The tables of one map. No lock is held while a table is built.
#[derive(Debug)]
pub(crate) struct TableStore {
    policy: TablePolicy,
    /// Memory that all tables may take \[bytes\]; the oldest make room.
    budget: usize,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    built: HashMap<TableKey, Table>,
    /// The keys of `built`, the oldest first.
    order: Vec<TableKey>,
    /// Tables that were asked for and are not built, in the order of asking.
    pending: Vec<TableKey>,
}

impl TableStore {
    /// An empty store.
    pub(crate) fn new(policy: TablePolicy, budget: usize) -> Self {
        Self {
            policy,
            budget,
            state: Mutex::default(),
        }
    }

    /// The policy.
    pub(crate) fn policy(&self) -> TablePolicy {
        self.policy
    }

    /// Memory that all tables may take \[bytes\].
    pub(crate) fn budget(&self) -> usize {
        self.budget
    }

    /// A table if it is there. Else, by the policy, it is built now or put on the list of pending ones.
    pub(crate) fn get(&self, key: TableKey, build: impl FnOnce() -> Table) -> Option<Table> {
        match self.policy {
            TablePolicy::BuildNow => Some(self.build(key, build)),
            TablePolicy::Defer => {
                let mut state = self.state();
                let table = state.built.get(&key).cloned();
                if table.is_none() && !state.pending.contains(&key) {
                    state.pending.push(key);
                }
                table
            }
        }
    }

    /// A table, built now if it is not there. Two threads that ask at the same time both build it, and one result is kept.
    pub(crate) fn build(&self, key: TableKey, build: impl FnOnce() -> Table) -> Table {
        if let Some(table) = self.state().built.get(&key) {
            return table.clone();
        }
        let table = build();
        let mut state = self.state();
        state.pending.retain(|pending| *pending != key);
        if let Some(table) = state.built.get(&key) {
            return table.clone();
        }
        state.built.insert(key, table.clone());
        state.order.push(key);
        // Who uses an old one keeps it.
        while state.order.len() > 1 && state.built.values().map(Table::bytes).sum::<usize>() > self.budget {
            let oldest = state.order.remove(0);
            state.built.remove(&oldest);
        }
        table
    }

    /// The tables that localizers wait for, the oldest first.
    pub(crate) fn pending(&self) -> Vec<TableKey> {
        self.state().pending.clone()
    }

    /// Memory that all tables take \[bytes\].
    pub(crate) fn bytes(&self) -> usize {
        self.state().built.values().map(Table::bytes).sum()
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
