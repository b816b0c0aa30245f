//! "Did you mean": the known name nearest to a mistyped one.

/// The candidate with the least edit distance to `name`, when that is near enough to be a typing error.
pub(crate) fn nearest<'a, I>(name: &str, candidates: I) -> Option<&'a str>
where
    I: IntoIterator<Item = &'a str>,
{
    let limit = match name.chars().count() {
        0 | 1 => 0,
        2 | 3 => 1,
        4..=6 => 2,
        _ => 3,
    };
    let folded = name.to_lowercase();
    candidates
        .into_iter()
        .map(|candidate| (distance(&folded, &candidate.to_lowercase()), candidate))
        .filter(|(distance, _)| *distance <= limit)
        .min()
        .map(|(_, candidate)| candidate)
}

/// The fix for an unknown name: the nearest one, else the list of all.
pub(crate) fn fix<'a, I>(name: &str, candidates: I) -> String
where
    I: IntoIterator<Item = &'a str>,
{
    let candidates: Vec<&str> = candidates.into_iter().collect();
    if let Some(near) = nearest(name, candidates.iter().copied()) {
        return format!("did you mean `{near}`?");
    }
    match candidates.as_slice() {
        [] => String::new(),
        [only] => format!("the only one is `{only}`"),
        many if many.len() <= 12 => format!("one of `{}`", many.join("`, `")),
        many => format!(
            "one of `{}`, ... ({} in all)",
            many[..12].join("`, `"),
            many.len()
        ),
    }
}

/// Insertions, deletions, substitutions and swaps of neighbours (optimal string alignment).
fn distance(a: &str, b: &str) -> usize {
    let a: Vec<char> = a.chars().take(64).collect();
    let b: Vec<char> = b.chars().take(64).collect();
    let width = b.len() + 1;
    let mut before: Vec<usize> = vec![0; width];
    let mut above: Vec<usize> = (0..width).collect();
    for row in 1..=a.len() {
        let mut current = vec![row; width];
        for column in 1..width {
            let substitution = usize::from(a[row - 1] != b[column - 1]);
            let mut best = (above[column] + 1)
                .min(current[column - 1] + 1)
                .min(above[column - 1] + substitution);
            let swapped =
                row > 1 && column > 1 && a[row - 1] == b[column - 2] && a[row - 2] == b[column - 1];
            if swapped {
                best = best.min(before[column - 2] + 1);
            }
            current[column] = best;
        }
        before = std::mem::replace(&mut above, current);
    }
    above[b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn near_names() {
        assert_eq!(nearest("clas", ["class", "program"]), Some("class"));
        assert_eq!(nearest("alhpa", ["beta", "alpha"]), Some("alpha"));
        assert_eq!(nearest("c", ["b", "d"]), None);
        assert_eq!(nearest("c", ["b", "C"]), Some("C"));
        assert_eq!(nearest("zebra", ["alpha", "beta"]), None);
        assert_eq!(fix("zebra", ["alpha"]), "the only one is `alpha`");
    }
}
