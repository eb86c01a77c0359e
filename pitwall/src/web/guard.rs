//! Access control of the page.

use std::collections::hash_map::RandomState;
use std::hash::{BuildHasher, Hasher};
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;

use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::middleware::Next;
use axum::response::{Html, IntoResponse, Response};

/// The page may only load from and connect to its own origin.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; \
                      connect-src 'self'; frame-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'";

/// Why a request without the token is rejected.
const NO_TOKEN: &str = "the token is missing: see the terminal";
/// Asks for the token.
const ASK_FOR_TOKEN: &str = "<!doctype html><html lang=\"en\"><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width\">\
    <title>pit wall</title><body style=\"font:16px system-ui;margin:2rem\"><h1>pit wall</h1><p>This page needs the token that \
    <code>pitwall</code> prints in its terminal. It is another one after each start.</p>\
    <form><label>token <input name=\"token\" autofocus autocomplete=\"off\" size=\"36\"></label> <button>open</button></form></body></html>";

/// Accepts requests of the page's own origin, and on a network only with the token.
#[derive(Clone)]
pub(super) struct Guard {
    token: Option<String>,
}

impl Guard {
    const COOKIE: &str = "pitwall";

    /// A guard for a server at `address`.
    pub(super) fn new(address: SocketAddr) -> Self {
        // The keys of a RandomState come from the operating system's random numbers.
        let random = || RandomState::new().build_hasher().finish();
        let token = (!address.ip().is_loopback()).then(|| format!("{:016x}{:016x}", random(), random()));
        Self { token }
    }

    /// The URL for a browser.
    pub(super) fn url(&self, address: SocketAddr) -> String {
        match &self.token {
            Some(token) => format!("http://{address}/?token={token}"),
            None => format!("http://{address}/"),
        }
    }

    fn admits(&self, request: &Request) -> Result<(), &'static str> {
        let headers = request.headers();
        let text = |name| {
            headers
                .get(name)
                .and_then(|value: &HeaderValue| value.to_str().ok())
        };
        let host = text(header::HOST).ok_or("no Host")?;
        // A host name is rejected, because anybody can make a name point here.
        let name = host.rsplit_once(':').map_or(host, |(name, _)| name);
        if name != "localhost" && name.trim_matches(['[', ']']).parse::<IpAddr>().is_err() {
            return Err("use the address, not a name");
        }
        if let Some(origin) = text(header::ORIGIN)
            && origin.strip_prefix("http://") != Some(host)
        {
            return Err("another site's page");
        }
        match &self.token {
            Some(token) if !knows(headers, request.uri().query(), token) => Err(NO_TOKEN),
            _ => Ok(()),
        }
    }
}

fn knows(headers: &HeaderMap, query: Option<&str>, token: &str) -> bool {
    let cookie = format!("{}={token}", Guard::COOKIE);
    let in_cookie = headers
        .get_all(header::COOKIE)
        .iter()
        .filter_map(|value| value.to_str().ok())
        .any(|value| value.split(';').any(|part| part.trim() == cookie));
    let parameter = format!("token={token}");
    in_cookie || query.is_some_and(|query| query.split('&').any(|part| part == parameter))
}

/// Checks a request, and adds the security headers to its response.
pub(super) async fn check(State(guard): State<Arc<Guard>>, request: Request, next: Next) -> Response {
    let request_path = request.uri().path().to_owned();
    let mut response = match guard.admits(&request) {
        Ok(()) => next.run(request).await,
        // Whoever opens the page without the token, or with that of an earlier run, is asked for it.
        Err(why) if why == NO_TOKEN && request_path == "/" => {
            return (StatusCode::FORBIDDEN, Html(ASK_FOR_TOKEN)).into_response();
        }
        Err(why) => return (StatusCode::FORBIDDEN, why).into_response(),
    };
    let headers = response.headers_mut();
    // The viewer in the pane has its own policy.
    headers
        .entry(header::CONTENT_SECURITY_POLICY)
        .or_insert(HeaderValue::from_static(POLICY));
    headers.insert(
        header::X_CONTENT_TYPE_OPTIONS,
        HeaderValue::from_static("nosniff"),
    );
    headers.insert(header::REFERRER_POLICY, HeaderValue::from_static("no-referrer"));
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    if let Some(token) = &guard.token
        && let Ok(cookie) = HeaderValue::from_str(&format!(
            "{}={token}; HttpOnly; SameSite=Strict; Path=/",
            Guard::COOKIE
        ))
    {
        headers.insert(header::SET_COOKIE, cookie);
    }
    response
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::body::Body;

    fn request(headers: &[(&str, &str)], uri: &str) -> Request {
        let mut request = Request::builder().uri(uri);
        for (name, value) in headers {
            request = request.header(*name, *value);
        }
        request.body(Body::empty()).expect("a good request")
    }

    #[test]
    fn on_loopback_only_the_pages_own_origin_gets_in() {
        let guard = Guard::new(SocketAddr::from(([127, 0, 0, 1], 7448)));
        let host = ("host", "127.0.0.1:7448");
        assert!(guard.admits(&request(&[host], "/")).is_ok());
        assert!(
            guard
                .admits(&request(&[host, ("origin", "http://127.0.0.1:7448")], "/command"))
                .is_ok()
        );
        assert!(
            guard
                .admits(&request(&[host, ("origin", "http://evil.example")], "/command"))
                .is_err()
        );
        assert!(
            guard
                .admits(&request(&[("host", "evil.example:7448")], "/"))
                .is_err()
        );
        assert!(guard.admits(&request(&[], "/")).is_err());
    }

    #[test]
    fn on_a_network_a_token_is_asked_for() {
        let address = SocketAddr::from(([192, 168, 1, 2], 7448));
        let guard = Guard::new(address);
        let token = guard.token.clone().expect("a token");
        let host = ("host", "192.168.1.2:7448");
        assert!(guard.admits(&request(&[host], "/")).is_err());
        assert!(guard.admits(&request(&[host], "/?token=0")).is_err());
        assert!(
            guard
                .admits(&request(&[host], &format!("/?token={token}")))
                .is_ok()
        );
        let cookie = format!("a=b; pitwall={token}");
        assert!(
            guard
                .admits(&request(&[host, ("cookie", &cookie)], "/ws"))
                .is_ok()
        );
        assert_ne!(Guard::new(address).token, guard.token);
    }
}
