//! Corrupted files, for robustness tests.

use crate::rng::Rng;

/// Returns a damaged copy of a file: bits flipped, bytes overwritten, truncated, inserted, duplicated or removed, a
/// header field or a number in a text replaced. One to three of these, depending on the seed; never the original bytes.
pub fn corrupt(bytes: &[u8], seed: u64) -> Vec<u8> {
    let mut rng = Rng::new(seed, 0xC0);
    let mut damaged = bytes.to_vec();
    for _ in 0..1 + below(&mut rng, 3) {
        damage(&mut damaged, &mut rng);
    }
    if damaged == bytes {
        damaged.push(0);
    }
    damaged
}

/// Returns a random number below `end`; 0 for `end` = 0.
fn below(rng: &mut Rng, end: usize) -> usize {
    (rng.next() % end.max(1) as u64) as usize
}

/// Applies one kind of damage.
fn damage(bytes: &mut Vec<u8>, rng: &mut Rng) {
    let n = bytes.len();
    // Half of the time in the header.
    let range = if below(rng, 2) == 0 { n.min(96) } else { n };
    let at = below(rng, range);
    let length = (1 + below(rng, 64)).min(n - at);
    match below(rng, 10) {
        0..=2 if n > 0 => (0..=below(rng, 8)).for_each(|_| {
            let at = below(rng, range);
            bytes[at] ^= 1 << below(rng, 8);
        }),
        3 if n > 0 => {
            let value = [0, 0xff, 0x20, rng.next() as u8][below(rng, 4)];
            bytes[at..at + length].fill(value);
        }
        4 => bytes.truncate(at),
        5 => {
            let noise: Vec<u8> = (0..1 + below(rng, 64)).map(|_| rng.next() as u8).collect();
            bytes.splice(at..at, noise);
        }
        6 => {
            let chunk = bytes[at..at + length].to_vec();
            bytes.splice(at..at, chunk);
        }
        7 => drop(bytes.drain(at..at + length)),
        // A size, a count or an offset.
        8 if n >= 4 => {
            let at = at.min(n - 4);
            let value =
                [0, 1, 0x7fff, 0xffff, 0x0001_0000, 0x0010_0000, 0x7fff_ffff, 0x8000_0000, u32::MAX][below(rng, 9)];
            let word = if below(rng, 2) == 0 { value.to_be_bytes() } else { value.to_le_bytes() };
            bytes[at..at + 4].copy_from_slice(&word);
        }
        _ => replace_number(bytes, rng),
    }
}

/// Replaces a number in a text by something else.
fn replace_number(bytes: &mut Vec<u8>, rng: &mut Rng) {
    let digits = |b: &u8| b.is_ascii_digit() || matches!(b, b'.' | b'-' | b'+');
    let starts: Vec<usize> =
        (0..bytes.len()).filter(|&i| digits(&bytes[i]) && (i == 0 || !digits(&bytes[i - 1]))).collect();
    let Some(&start) = starts.get(below(rng, starts.len())) else { return bytes.clear() };
    let end = start + bytes[start..].iter().take_while(|b| digits(b)).count();
    let words =
        ["nan", "inf", "-1", "0", "1e308", "-1e-308", "4294967296", "18446744073709551616", "", "x", "1e5", "0x10"];
    bytes.splice(start..end, words[below(rng, words.len())].bytes());
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_seed_does_damage_and_always_the_same() {
        for bytes in [&b""[..], b"P6\n2 2\n255\n0123456789ab", &[7; 300]] {
            for seed in 0..2000 {
                let damaged = corrupt(bytes, seed);
                assert!(damaged != bytes && damaged.len() <= bytes.len() + 200, "{seed}");
                assert_eq!(damaged, corrupt(bytes, seed));
            }
        }
    }
}
