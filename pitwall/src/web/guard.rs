//! Access control of the page.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::Arc;

use axum::Form;
use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Redirect, Response};
use keys::{Bundle, OperatorToken, Token, equal_in_constant_time};
use serde::Deserialize;
use tokio_rustls::TlsAcceptor;

use super::connections::{self, Admitted};

/// The page may only load from and connect to its own origin.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; \
                      connect-src 'self'; frame-src 'self'; base-uri 'none'; form-action 'self'; frame-ancestors 'self'";

/// What the login page needs before anybody has logged in.
const PUBLIC: [&str; 2] = ["/style.css", "/icon.svg"];

/// Accepts requests of the page's own origin, and on a network only with a token.
#[derive(Clone)]
pub(super) struct Guard {
    /// None on loopback.
    token: Option<Token>,
    /// Operators with a token of their own.
    operators: Vec<OperatorToken>,
    /// True for HTTPS.
    secure: bool,
    /// Accepts the connections of a page with HTTPS.
    pub(super) tls: Option<TlsAcceptor>,
}

/// Who sent a request.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Access {
    /// The operator whose token it is. None where the page asks for no token, or for the token of the pit wall, which does not
    /// say who uses it.
    pub(super) operator: Option<String>,
}

impl Access {
    /// The name to act under: the owner of the token, else the name that was typed.
    pub(super) fn name(&self, typed: String) -> String {
        self.operator.clone().unwrap_or(typed)
    }
}

/// Why a request is refused.
#[derive(Debug, PartialEq, Eq)]
enum Refusal {
    /// It does not come from the page.
    Foreign(&'static str),
    /// It has no valid token.
    Login,
}

impl Guard {
    const COOKIE: &str = "pitwall";

    /// A guard for a server at `address`. Only beyond loopback a token is needed.
    pub(super) fn new(
        address: SocketAddr,
        operators: Vec<OperatorToken>,
        secure: bool,
    ) -> std::io::Result<Self> {
        let token = if address.ip().is_loopback() {
            None
        } else {
            let none = || std::io::Error::other("the system has no random numbers for a token");
            Some(Token::new().ok_or_else(none)?)
        };
        Ok(Self {
            token,
            operators,
            secure,
            tls: None,
        })
    }

    /// A guard with HTTPS when there are keys and the address is beyond loopback.
    pub(super) fn with_keys(address: SocketAddr, keys: Option<&Bundle>) -> std::io::Result<Self> {
        let Some(keys) = keys.filter(|_| !address.ip().is_loopback()) else {
            return Self::new(address, Vec::new(), false);
        };
        let tls =
            connections::acceptor(keys).map_err(|error| std::io::Error::other(format!("TLS: {error}")))?;
        let guard = Self::new(address, keys.operators.clone(), true)?;
        Ok(Self {
            tls: Some(tls),
            ..guard
        })
    }

    /// The URL for a browser.
    pub(super) fn url(&self, address: SocketAddr) -> String {
        let scheme = self.scheme();
        // Whoever reads this is on the same machine.
        let address = match address {
            SocketAddr::V4(v4) if v4.ip().is_unspecified() => (Ipv4Addr::LOCALHOST, v4.port()).into(),
            SocketAddr::V6(v6) if v6.ip().is_unspecified() => (Ipv6Addr::LOCALHOST, v6.port()).into(),
            specified => specified,
        };
        match &self.token {
            Some(token) => format!("{scheme}://{address}/?token={}", token.reveal()),
            None => format!("{scheme}://{address}/"),
        }
    }

    fn scheme(&self) -> &'static str {
        if self.secure { "https" } else { "http" }
    }

    fn admits(&self, request: &Request) -> Result<Access, Refusal> {
        let headers = request.headers();
        let text = |name| {
            headers
                .get(name)
                .and_then(|value: &HeaderValue| value.to_str().ok())
        };
        let host = text(header::HOST).ok_or(Refusal::Foreign("no Host"))?;
        // Anybody can make a name point here. Over HTTPS the browser has compared it with the certificate.
        let name = host.rsplit_once(':').map_or(host, |(name, _)| name);
        if !self.secure && name != "localhost" && name.trim_matches(['[', ']']).parse::<IpAddr>().is_err() {
            return Err(Refusal::Foreign("use the address, not a name"));
        }
        if let Some(origin) = text(header::ORIGIN)
            && origin.split_once("://") != Some((self.scheme(), host))
        {
            return Err(Refusal::Foreign("another site's page"));
        }
        if self.token.is_none() {
            return Ok(Access::default());
        }
        token_in_cookie(headers)
            .and_then(|token| self.owner(token))
            .ok_or(Refusal::Login)
    }

    /// Whose token it is; None when it is nobody's.
    fn owner(&self, token: &str) -> Option<Access> {
        let shared = self.token.as_ref()?;
        // All are compared, so that the time does not show which one was close.
        let mut owner = None;
        for operator in &self.operators {
            if operator.matches(token) {
                owner = Some(operator.name.to_string());
            }
        }
        let operator = owner;
        let shared = equal_in_constant_time(shared.reveal(), token);
        (shared || operator.is_some()).then_some(Access { operator })
    }

    /// Lets a browser in that has a valid token, and sends others to the login page.
    fn log_in(&self, token: &str) -> Response {
        if self.owner(token).is_none() {
            return login_page(Some("That is not the token."));
        }
        let secure = if self.secure { "; Secure" } else { "" };
        let cookie = format!(
            "{}={token}; HttpOnly; SameSite=Strict; Path=/{secure}",
            Self::COOKIE
        );
        // The token does not stay in the address.
        let mut response = Redirect::to("/").into_response();
        if let Ok(cookie) = HeaderValue::from_str(&cookie) {
            response.headers_mut().insert(header::SET_COOKIE, cookie);
        }
        response
    }
}

fn token_in_cookie(headers: &HeaderMap) -> Option<&str> {
    headers
        .get_all(header::COOKIE)
        .iter()
        .filter_map(|value| value.to_str().ok())
        .flat_map(|value| value.split(';'))
        .find_map(|part| part.trim().strip_prefix(Guard::COOKIE)?.strip_prefix('='))
}

fn token_in_query(query: Option<&str>) -> Option<&str> {
    query?.split('&').find_map(|part| part.strip_prefix("token="))
}

fn login_page(fault: Option<&str>) -> Response {
    let page = include_str!("page/login.html").replace("FAULT", fault.unwrap_or_default());
    let kind = [(header::CONTENT_TYPE, "text/html; charset=utf-8")];
    (StatusCode::UNAUTHORIZED, kind, page).into_response()
}

/// The form of the login page.
#[derive(Deserialize)]
pub(super) struct Login {
    token: String,
}

/// Checks a request, and adds the security headers to its response.
pub(super) async fn check(State(guard): State<Arc<Guard>>, mut request: Request, next: Next) -> Response {
    let mut response = match guard.admits(&request) {
        Ok(access) => {
            if let Some(admitted) = request.extensions().get::<Admitted>() {
                admitted.set();
            }
            request.extensions_mut().insert(access);
            next.run(request).await
        }
        Err(Refusal::Foreign(why)) => return (StatusCode::FORBIDDEN, why).into_response(),
        Err(Refusal::Login) => not_logged_in(&guard, request, next).await,
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
    response
}

async fn not_logged_in(guard: &Guard, request: Request, next: Next) -> Response {
    let path = request.uri().path();
    match (request.method(), path) {
        (&Method::POST, "/login") => {
            let form = axum::RequestExt::extract::<Form<Login>, _>(request).await;
            match form {
                Ok(Form(Login { token })) => guard.log_in(token.trim()),
                Err(_) => login_page(Some("Type the token.")),
            }
        }
        (&Method::GET, path) if PUBLIC.contains(&path) => next.run(request).await,
        (&Method::GET, "/") => match token_in_query(request.uri().query()) {
            Some(token) => guard.log_in(token),
            None => login_page(None),
        },
        _ => (StatusCode::UNAUTHORIZED, "log in first").into_response(),
    }
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

    fn guard(address: [u8; 4], secure: bool) -> Guard {
        Guard::new((address, 7448).into(), Vec::new(), secure).expect("random numbers")
    }

    #[test]
    fn on_loopback_only_the_pages_own_origin_gets_in() {
        let guard = guard([127, 0, 0, 1], false);
        let host = ("host", "127.0.0.1:7448");
        assert!(guard.admits(&request(&[host], "/")).is_ok());
        let own = ("origin", "http://127.0.0.1:7448");
        assert!(guard.admits(&request(&[host, own], "/command")).is_ok());
        for origin in ["http://evil.example", "https://127.0.0.1:7448", "null"] {
            let foreign = guard.admits(&request(&[host, ("origin", origin)], "/command"));
            assert!(matches!(foreign, Err(Refusal::Foreign(_))), "{origin}");
        }
        assert!(
            guard
                .admits(&request(&[("host", "evil.example:7448")], "/"))
                .is_err()
        );
        assert!(guard.admits(&request(&[], "/")).is_err());
    }

    #[test]
    fn on_a_network_a_token_is_asked_for() {
        let guard = guard([192, 168, 1, 2], false);
        let token = guard.token.clone().expect("a token");
        let host = ("host", "192.168.1.2:7448");
        assert_eq!(guard.admits(&request(&[host], "/ws")), Err(Refusal::Login));
        let wrong = ("cookie", "pitwall=0");
        assert_eq!(guard.admits(&request(&[host, wrong], "/ws")), Err(Refusal::Login));
        let cookie = format!("a=b; pitwall={}", token.reveal());
        assert_eq!(
            guard.admits(&request(&[host, ("cookie", &cookie)], "/ws")),
            Ok(Access::default())
        );
        let entered = guard.log_in(token.reveal());
        assert_eq!(entered.status(), StatusCode::SEE_OTHER);
        assert_eq!(entered.headers()[header::LOCATION], "/");
        assert!(entered.headers().contains_key(header::SET_COOKIE));
        let refused = guard.log_in("0");
        assert_eq!(refused.status(), StatusCode::UNAUTHORIZED);
        assert!(!refused.headers().contains_key(header::SET_COOKIE));
    }

    #[test]
    fn an_operators_token_decides_the_operators_name() {
        let mut guard = guard([0, 0, 0, 0], true);
        let token = Token::new().expect("random numbers");
        let name = "ana".parse().expect("a name");
        guard.operators.push(OperatorToken::new(name, token.reveal()));
        let cookie = format!("pitwall={}", token.reveal());
        // Over HTTPS a host may have a name.
        let headers = [("host", "pit.local:7448"), ("cookie", cookie.as_str())];
        let access = guard.admits(&request(&headers, "/command")).expect("let in");
        assert_eq!(access.name("mallory".into()), "ana");
        assert_eq!(Access::default().name("ben".into()), "ben");
        let cookie = guard.log_in(token.reveal()).headers()[header::SET_COOKIE].clone();
        assert!(cookie.to_str().expect("text").contains("; Secure"));
    }
}
