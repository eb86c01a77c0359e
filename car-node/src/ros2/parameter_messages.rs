//! The messages of `rcl_interfaces` by which nodes show and change each other's parameters.

use protocol::Value;
use serde::{Deserialize, Serialize};

use super::messages::Time;

/// What a parameter's value may be: `rcl_interfaces/msg/ParameterType`.
const BOOL: u8 = 1;
const INTEGER: u8 = 2;
const DOUBLE: u8 = 3;
const STRING: u8 = 4;

/// `rcl_interfaces/msg/ParameterValue`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct ParameterValue {
    /// Which of the values counts; 0 for none.
    pub kind: u8,
    /// A flag.
    pub bool_value: bool,
    /// A count.
    pub integer_value: i64,
    /// A quantity.
    pub double_value: f64,
    /// A word.
    pub string_value: String,
    /// Bytes.
    pub byte_array_value: Vec<u8>,
    /// Flags.
    pub bool_array_value: Vec<bool>,
    /// Counts.
    pub integer_array_value: Vec<i64>,
    /// Quantities.
    pub double_array_value: Vec<f64>,
    /// Words.
    pub string_array_value: Vec<String>,
}

impl ParameterValue {
    /// The value; None for no value and for an array.
    pub fn value(&self) -> Option<Value> {
        match self.kind {
            BOOL => Some(Value::Bool(self.bool_value)),
            INTEGER => Some(Value::Int(self.integer_value)),
            DOUBLE => Some(Value::Float(self.double_value)),
            STRING => Some(Value::Text(self.string_value.clone())),
            _ => None,
        }
    }
}

impl From<&Value> for ParameterValue {
    fn from(value: &Value) -> Self {
        let none = Self {
            kind: kind_of(value),
            ..Self::default()
        };
        match value {
            Value::Bool(value) => Self {
                bool_value: *value,
                ..none
            },
            Value::Int(value) => Self {
                integer_value: *value,
                ..none
            },
            Value::Float(value) => Self {
                double_value: *value,
                ..none
            },
            Value::Text(value) => Self {
                string_value: value.clone(),
                ..none
            },
        }
    }
}

/// The type of a value.
pub fn kind_of(value: &Value) -> u8 {
    match value {
        Value::Bool(_) => BOOL,
        Value::Int(_) => INTEGER,
        Value::Float(_) => DOUBLE,
        Value::Text(_) => STRING,
    }
}

/// `rcl_interfaces/msg/Parameter`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Parameter {
    /// The name.
    pub name: String,
    /// The value.
    pub value: ParameterValue,
}

/// `rcl_interfaces/msg/FloatingPointRange`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct FloatRange {
    /// From, to, and the step between; 0 for any.
    pub range: [f64; 3],
}

/// `rcl_interfaces/msg/IntegerRange`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct IntegerRange {
    /// From and to.
    pub range: [i64; 2],
    /// The step between; 0 for any.
    pub step: u64,
}

/// `rcl_interfaces/msg/ParameterDescriptor`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct ParameterDescriptor {
    /// The name.
    pub name: String,
    /// The type of its value.
    pub kind: u8,
    /// What it does.
    pub description: String,
    /// What its value must be.
    pub additional_constraints: String,
    /// It cannot be set.
    pub read_only: bool,
    /// It may be set to a value of another type.
    pub dynamic_typing: bool,
    /// The range of a quantity, if one is stated.
    pub floating_point_range: Vec<FloatRange>,
    /// The range of a count, if one is stated.
    pub integer_range: Vec<IntegerRange>,
}

/// `rcl_interfaces/msg/ParameterEvent`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct ParameterEvent {
    /// When.
    pub stamp: Time,
    /// The node's full name.
    pub node: String,
    /// Parameters that are new.
    pub new_parameters: Vec<Parameter>,
    /// Parameters that have another value.
    pub changed_parameters: Vec<Parameter>,
    /// Parameters that are gone.
    pub deleted_parameters: Vec<Parameter>,
}

/// `rcl_interfaces/msg/SetParametersResult`.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct SetResult {
    /// It was set.
    pub successful: bool,
    /// Why not.
    pub reason: String,
}

/// The request of `GetParameters`, `GetParameterTypes` and `DescribeParameters`.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Names {
    /// The parameters.
    pub names: Vec<String>,
}

/// The request of `ListParameters`.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct ListRequest {
    /// Only what is under these; all without any.
    pub prefixes: Vec<String>,
    /// How deep; 0 without limit.
    pub depth: u64,
}

/// The reply of `ListParameters`: `rcl_interfaces/msg/ListParametersResult`.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct ListReply {
    /// The parameters.
    pub names: Vec<String>,
    /// Where there are more.
    pub prefixes: Vec<String>,
}

/// The request of `SetParameters` and `SetParametersAtomically`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Parameters {
    /// The parameters with their new values.
    pub parameters: Vec<Parameter>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros2::messages::{decode, encode};

    #[test]
    fn values_survive_a_round_trip() {
        for value in [
            Value::Bool(true),
            Value::Int(-3),
            Value::Float(0.25),
            Value::Text("tum".into()),
        ] {
            let parameters = Parameters {
                parameters: vec![Parameter {
                    name: "a".into(),
                    value: ParameterValue::from(&value),
                }],
            };
            let bytes = encode(&parameters).expect("encodes");
            let decoded: Parameters = decode(&bytes).expect("decodes");
            assert_eq!(decoded.parameters[0].value.value(), Some(value));
        }
        assert_eq!(ParameterValue::default().value(), None);
    }

    /// By hand: name, type, flag, padding to 8, count, quantity, empty word, five empty arrays.
    #[test]
    fn a_parameter_is_laid_out_as_ros_does() {
        let mut expected = vec![0, 1, 0, 0, 2, 0, 0, 0];
        expected.extend(b"a\0");
        expected.extend([DOUBLE, 0]);
        expected.extend(0_i64.to_le_bytes());
        expected.extend(0.5_f64.to_le_bytes());
        expected.extend([1, 0, 0, 0, 0, 0, 0, 0]);
        expected.extend([0; 16 + 4]);
        let parameter = Parameter {
            name: "a".into(),
            value: ParameterValue::from(&Value::Float(0.5)),
        };
        assert_eq!(encode(&parameter).expect("encodes"), expected);
    }
}
