//! Finds a NaN or an infinity anywhere in a message, with a serializer that writes nothing and stops at the first one.

use std::fmt;

use serde::{Serialize, ser};

use crate::Invalid;

/// Refuses a message with a float that is not finite.
pub(crate) fn check(message: &impl Serialize) -> Result<(), Invalid> {
    message.serialize(&mut Walker { field: "value" }).map_err(|e| e.0)
}

/// Remembers the innermost field it is in.
struct Walker {
    field: &'static str,
}

#[derive(Debug)]
struct Found(Invalid);

impl fmt::Display for Found {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

impl std::error::Error for Found {}

impl ser::Error for Found {
    fn custom<T: fmt::Display>(message: T) -> Self {
        Self(Invalid::new("value", message.to_string()))
    }
}

impl Walker {
    fn number(&self, value: f64) -> Result<(), Found> {
        if value.is_finite() {
            Ok(())
        } else {
            Err(Found(Invalid::new(
                self.field,
                format!("{value} is not a number"),
            )))
        }
    }
}

/// Values that cannot be wrong.
macro_rules! pass {
    ($($method:ident($($of:ty),*),)*) => {
        $(fn $method(self, $(_: $of),*) -> Result<(), Found> { Ok(()) })*
    };
}

/// Values that hold others.
macro_rules! enter {
    ($($method:ident($($of:ty),*) -> $compound:ident,)*) => {
        $(
            type $compound = Self;

            fn $method(self, $(_: $of),*) -> Result<Self, Found> { Ok(self) }
        )*
    };
}

impl ser::Serializer for &mut Walker {
    type Ok = ();
    type Error = Found;

    pass! {
        serialize_bool(bool), serialize_i8(i8), serialize_i16(i16), serialize_i32(i32), serialize_i64(i64),
        serialize_u8(u8), serialize_u16(u16), serialize_u32(u32), serialize_u64(u64), serialize_i128(i128),
        serialize_u128(u128), serialize_char(char), serialize_str(&str), serialize_bytes(&[u8]),
        serialize_none(), serialize_unit(), serialize_unit_struct(&'static str),
        serialize_unit_variant(&'static str, u32, &'static str),
    }

    enter! {
        serialize_seq(Option<usize>) -> SerializeSeq,
        serialize_tuple(usize) -> SerializeTuple,
        serialize_tuple_struct(&'static str, usize) -> SerializeTupleStruct,
        serialize_tuple_variant(&'static str, u32, &'static str, usize) -> SerializeTupleVariant,
        serialize_map(Option<usize>) -> SerializeMap,
        serialize_struct(&'static str, usize) -> SerializeStruct,
        serialize_struct_variant(&'static str, u32, &'static str, usize) -> SerializeStructVariant,
    }

    fn serialize_f32(self, value: f32) -> Result<(), Found> {
        self.number(value.into())
    }

    fn serialize_f64(self, value: f64) -> Result<(), Found> {
        self.number(value)
    }

    fn serialize_some<T: Serialize + ?Sized>(self, value: &T) -> Result<(), Found> {
        value.serialize(self)
    }

    fn serialize_newtype_struct<T: Serialize + ?Sized>(
        self,
        _: &'static str,
        value: &T,
    ) -> Result<(), Found> {
        value.serialize(self)
    }

    fn serialize_newtype_variant<T: Serialize + ?Sized>(
        self,
        _: &'static str,
        _: u32,
        _: &'static str,
        value: &T,
    ) -> Result<(), Found> {
        value.serialize(self)
    }

    fn is_human_readable(&self) -> bool {
        false
    }
}

macro_rules! elements {
    ($($trait:ident $method:ident,)*) => {
        $(impl ser::$trait for &mut Walker {
            type Ok = ();
            type Error = Found;

            fn $method<T: Serialize + ?Sized>(&mut self, value: &T) -> Result<(), Found> {
                value.serialize(&mut **self)
            }

            fn end(self) -> Result<(), Found> {
                Ok(())
            }
        })*
    };
}

elements! {
    SerializeSeq serialize_element,
    SerializeTuple serialize_element,
    SerializeTupleStruct serialize_field,
    SerializeTupleVariant serialize_field,
}

impl ser::SerializeMap for &mut Walker {
    type Ok = ();
    type Error = Found;

    fn serialize_key<T: Serialize + ?Sized>(&mut self, key: &T) -> Result<(), Found> {
        key.serialize(&mut **self)
    }

    fn serialize_value<T: Serialize + ?Sized>(&mut self, value: &T) -> Result<(), Found> {
        value.serialize(&mut **self)
    }

    fn end(self) -> Result<(), Found> {
        Ok(())
    }
}

macro_rules! fields {
    ($($trait:ident,)*) => {
        $(impl ser::$trait for &mut Walker {
            type Ok = ();
            type Error = Found;

            fn serialize_field<T: Serialize + ?Sized>(&mut self, name: &'static str, value: &T) -> Result<(), Found> {
                self.field = name;
                value.serialize(&mut **self)
            }

            fn end(self) -> Result<(), Found> {
                Ok(())
            }
        })*
    };
}

fields! { SerializeStruct, SerializeStructVariant, }

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Serialize)]
    struct Deep {
        fine: f32,
        nested: Vec<Option<Inner>>,
    }

    #[derive(Serialize)]
    struct Inner {
        slip: f64,
    }

    #[test]
    fn the_field_is_named_however_deep() {
        let deep = |slip| Deep {
            fine: 1.0,
            nested: vec![None, Some(Inner { slip })],
        };
        assert_eq!(check(&deep(0.5)), Ok(()));
        for value in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            assert_eq!(check(&deep(value)).map_err(|e| e.field), Err("slip"));
        }
    }
}
