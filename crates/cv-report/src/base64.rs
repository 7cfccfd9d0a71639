//! Base64 encoding (RFC 4648, section 4).

pub(crate) fn encode(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let digit = |v: u32| char::from(DIGITS[(v & 63) as usize]);
    let mut out = String::with_capacity(bytes.len().div_ceil(3) * 4);
    let (groups, rest) = bytes.as_chunks::<3>();
    for &[a, b, c] in groups {
        let v = u32::from(a) << 16 | u32::from(b) << 8 | u32::from(c);
        out.extend([digit(v >> 18), digit(v >> 12), digit(v >> 6), digit(v)]);
    }
    match *rest {
        [a] => out.extend([digit(u32::from(a) >> 2), digit(u32::from(a) << 4), '=', '=']),
        [a, b] => {
            let v = u32::from(a) << 8 | u32::from(b);
            out.extend([digit(v >> 10), digit(v >> 4), digit(v << 2), '=']);
        }
        _ => {}
    }
    out
}

#[cfg(test)]
mod tests {
    #[test]
    fn test_vectors_of_the_rfc() {
        let examples = [
            ("", ""),
            ("f", "Zg=="),
            ("fo", "Zm8="),
            ("foo", "Zm9v"),
            ("foob", "Zm9vYg=="),
            ("fooba", "Zm9vYmE="),
            ("foobar", "Zm9vYmFy"),
        ];
        for (plain, coded) in examples {
            assert_eq!(super::encode(plain.as_bytes()), coded);
        }
        assert_eq!(super::encode(&[0xfb, 0xff, 0xfe]), "+//+");
    }
}
