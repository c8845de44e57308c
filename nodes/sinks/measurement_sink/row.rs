//! A row of figures with the names of their columns.

use serde::{Deserialize, Serialize};

/// One cell.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Figure {
    /// A number, or a count.
    Number(f64),
    /// A name.
    Text(String),
}

/// Cells in the order in which they were added; what is not known has none.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Row(pub Vec<(String, Figure)>);

impl Row {
    /// Adds a name.
    pub fn text(&mut self, column: &str, text: &str) {
        self.0.push((column.to_owned(), Figure::Text(text.to_owned())));
    }

    /// Adds a number, if it is one.
    pub fn number(&mut self, column: &str, number: f64) {
        if number.is_finite() {
            self.0.push((column.to_owned(), Figure::Number(number)));
        }
    }

    /// Adds a count.
    pub fn count(&mut self, column: &str, count: u64) {
        self.number(column, count as f64);
    }

    /// The cell of a column.
    pub fn get(&self, column: &str) -> Option<&Figure> {
        self.0.iter().find(|(name, _)| name == column).map(|(_, figure)| figure)
    }

    /// The number in a column.
    pub fn number_of(&self, column: &str) -> Option<f64> {
        if let Some(Figure::Number(number)) = self.get(column) { Some(*number) } else { None }
    }
}

impl Serialize for Row {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map(self.0.iter().map(|(column, figure)| (column, figure)))
    }
}
