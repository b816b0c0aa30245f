//! Bytes cut into lines, with a bound on what an endless line may hold.

/// Collects bytes and hands out lines.
#[derive(Debug)]
pub(crate) struct Lines {
    partial: Vec<u8>,
    limit: usize,
    /// Whether the line in `partial` goes on from a piece that was handed out already.
    continued: bool,
}

/// A line, or a piece of one that is longer than the limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Piece<'a> {
    /// The text without its newline.
    pub(crate) bytes: &'a [u8],
    /// Whether it goes on from the piece before.
    pub(crate) continued: bool,
    /// Whether the line's end was seen.
    pub(crate) whole: bool,
}

impl Lines {
    /// Hands out pieces of at most `limit` bytes.
    pub(crate) fn new(limit: usize) -> Self {
        Self {
            partial: Vec::new(),
            limit,
            continued: false,
        }
    }

    /// Takes bytes as they come and hands out every piece that is complete.
    ///
    /// Law: the pieces depend only on all bytes together, not on how they were split over calls.
    pub(crate) fn push(&mut self, mut bytes: &[u8], mut each: impl FnMut(Piece<'_>)) {
        while !bytes.is_empty() {
            let room = self.limit - self.partial.len();
            let newline = bytes.iter().take(room + 1).position(|byte| *byte == b'\n');
            let take = newline.unwrap_or_else(|| room.min(bytes.len()));
            self.partial.extend_from_slice(&bytes[..take]);
            bytes = &bytes[take..];
            if newline.is_some() {
                self.hand_out(true, &mut each);
                bytes = &bytes[1..];
            } else if !bytes.is_empty() {
                self.hand_out(false, &mut each);
            }
        }
    }

    /// Hands out what is left when nothing more comes.
    pub(crate) fn finish(&mut self, mut each: impl FnMut(Piece<'_>)) {
        if !self.partial.is_empty() {
            self.hand_out(true, &mut each);
        }
    }

    fn hand_out(&mut self, whole: bool, each: &mut impl FnMut(Piece<'_>)) {
        each(Piece {
            bytes: &self.partial,
            continued: self.continued,
            whole,
        });
        self.partial.clear();
        self.continued = !whole;
    }
}

#[cfg(test)]
mod tests {
    use super::Lines;

    fn pieces(limit: usize, input: &[u8], chunk: usize) -> Vec<(String, bool, bool)> {
        let mut lines = Lines::new(limit);
        let mut found = Vec::new();
        let mut keep = |piece: super::Piece<'_>| {
            let text = String::from_utf8_lossy(piece.bytes).into_owned();
            found.push((text, piece.continued, piece.whole));
        };
        for bytes in input.chunks(chunk) {
            lines.push(bytes, &mut keep);
        }
        lines.finish(&mut keep);
        found
    }

    #[test]
    fn pieces_do_not_depend_on_the_split() {
        let input = b"ab\n\nabcdefghij\nabcd\nrest";
        let whole = pieces(4, input, input.len());
        let texts: Vec<_> = whole.iter().map(|(text, ..)| text.as_str()).collect();
        assert_eq!(texts, ["ab", "", "abcd", "efgh", "ij", "abcd", "rest"]);
        let continued: Vec<_> = whole.iter().map(|(_, continued, _)| *continued).collect();
        assert_eq!(continued, [false, false, false, true, true, false, false]);
        for chunk in 1..input.len() {
            assert_eq!(pieces(4, input, chunk), whole, "chunks of {chunk}");
        }
    }
}
