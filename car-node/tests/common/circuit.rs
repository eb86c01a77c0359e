//! The order in which tests switch between parameter sets.

/// Passes through every ordered pair of the names once; begins and ends with the first.
pub(crate) fn circuit<'a>(names: &[&'a str]) -> Vec<&'a str> {
    let [first, rest @ ..] = names else {
        return Vec::new();
    };
    let mut circuit = vec![*first];
    // There and back, to all but one; the circuit of the rest begins and ends with that one.
    for other in rest.iter().skip(1) {
        circuit.extend([*other, first]);
    }
    if !rest.is_empty() {
        circuit.extend(self::circuit(rest));
        circuit.push(first);
    }
    circuit
}
