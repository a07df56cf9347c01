//! Python's values as TOML's, and back: settings come as dictionaries.

use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyBool, PyDict, PyList, PyString};
use toml::{Table, Value};

/// Deepest nesting of settings: no section is deeper than four.
const DEEPEST: usize = 8;

/// Converts a dictionary of settings. `name`: what errors call it.
///
/// # Errors
/// `TypeError` names the key and the type that no setting has.
pub(crate) fn table_of(settings: &Bound<'_, PyDict>, name: &str) -> PyResult<Table> {
    table_within(settings, name, 0)
}

fn table_within(settings: &Bound<'_, PyDict>, name: &str, depth: usize) -> PyResult<Table> {
    if depth == DEEPEST {
        return Err(PyValueError::new_err(format!(
            "{name} is nested deeper than any setting: write each section as one dictionary"
        )));
    }
    let mut table = Table::new();
    for (key, value) in settings.iter() {
        let key: String = key.extract().map_err(|_| {
            PyTypeError::new_err(format!("{name} has the key {key}: keys are strings"))
        })?;
        if value.is_none() {
            continue; // Absent, as in TOML.
        }
        let converted = value_of(&value, &format!("{name}.{key}"), depth + 1)?;
        table.insert(key, converted);
    }
    Ok(table)
}

fn value_of(value: &Bound<'_, PyAny>, name: &str, depth: usize) -> PyResult<Value> {
    if depth == DEEPEST {
        return Err(PyValueError::new_err(format!(
            "{name} is nested deeper than any setting: write it as one value or list"
        )));
    }
    if let Ok(table) = value.cast::<PyDict>() {
        return table_within(table, name, depth).map(Value::Table);
    }
    if value.is_instance_of::<PyBool>() {
        return Ok(Value::Boolean(value.extract()?));
    }
    if value.is_instance_of::<PyString>() {
        return Ok(Value::String(value.extract()?));
    }
    if let Ok(number) = value.extract::<i64>() {
        return Ok(Value::Integer(number));
    }
    if let Ok(number) = value.extract::<f64>() {
        return Ok(Value::Float(number));
    }
    let Ok(items) = value.try_iter() else {
        return Err(PyTypeError::new_err(format!(
            "{name} = {value} is a {}: settings are numbers, strings, booleans, lists and \
             dictionaries",
            value.get_type().name()?
        )));
    };
    let converted = items
        .enumerate()
        .map(|(place, item)| value_of(&item?, &format!("{name}[{place}]"), depth + 1));
    converted.collect::<PyResult<_>>().map(Value::Array)
}

/// Converts a table of TOML into a dictionary.
///
/// # Errors
/// If Python has no memory.
pub(crate) fn dict_of<'py>(py: Python<'py>, table: &Table) -> PyResult<Bound<'py, PyDict>> {
    let dict = PyDict::new(py);
    for (key, value) in table {
        dict.set_item(key, object_of(py, value)?)?;
    }
    Ok(dict)
}

fn object_of<'py>(py: Python<'py>, value: &Value) -> PyResult<Bound<'py, PyAny>> {
    Ok(match value {
        Value::String(text) => PyString::new(py, text).into_any(),
        Value::Integer(number) => number.into_pyobject(py)?.into_any(),
        Value::Float(number) => number.into_pyobject(py)?.into_any(),
        Value::Boolean(flag) => PyBool::new(py, *flag).to_owned().into_any(),
        Value::Datetime(moment) => PyString::new(py, &moment.to_string()).into_any(),
        Value::Array(items) => {
            let items = items.iter().map(|item| object_of(py, item));
            PyList::new(py, items.collect::<PyResult<Vec<_>>>()?)?.into_any()
        }
        Value::Table(table) => dict_of(py, table)?.into_any(),
    })
}
